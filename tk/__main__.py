"""`python -m tk`: the same as the command `tk`."""

from tk.cli import main

main(prog_name="tk")
