"""Runs: the plan, the session, the process that makes frames ahead, and what needs all frames."""
