"""Files that survive crashes: checkpoints, tables, locks; and progress on the terminal."""
