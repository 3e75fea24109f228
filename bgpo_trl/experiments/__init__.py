"""The paper's experiments: one run, and sweeps of runs on Ray."""
