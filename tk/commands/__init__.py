"""The commands of `tk`: one module each."""
