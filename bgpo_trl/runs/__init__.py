"""Run directories: settings, logs, saved graphs and results."""
