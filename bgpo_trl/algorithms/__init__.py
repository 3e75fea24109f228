"""The algorithms: each file says, top to bottom, how its parts compose."""
