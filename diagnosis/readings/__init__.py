"""What the runs of a campaign say, as numbers: one module for each kind of run or number."""
