"""A result as one self-contained HTML page: nothing is loaded from anywhere else."""
