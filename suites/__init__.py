"""Simulation suites: dm_control domains, independent of torch and ``bgpo_trl``."""
