"""Studies over seeds: the paper reproduced, its method beside others on the same data."""
