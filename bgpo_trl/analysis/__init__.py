"""Measures of continual learning and of task inference."""
