"""Measurements that only make sense for NICO's table."""
