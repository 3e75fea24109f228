"""Measures of continual learning and task inference, and the tables of the report."""
