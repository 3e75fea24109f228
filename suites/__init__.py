"""Simulation suites: dm_control domains that know nothing of torch or of ``bgpo_trl``."""
