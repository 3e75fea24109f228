"""Behavior-Guided Policy Optimization (Hafez & Wermter, 2021) for TorchRL."""
