"""The commands of `tk`, one module each. They import heavy modules when they run, so that `tk --help` stays fast."""
