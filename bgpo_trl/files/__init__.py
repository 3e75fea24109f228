"""Crash-safe files (checkpoints, CSV, tensors), locks, interrupts and progress bars."""
