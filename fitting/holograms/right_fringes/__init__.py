"""The right fringe for holograms that fell into a wrong one."""
