"""What the scripts in `benchmarks/` share: running an experiment, jobs on Ray, merging of runs."""
