"""Directories of runs: what training writes there, and how it is read back."""
