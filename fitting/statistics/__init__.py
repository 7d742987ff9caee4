"""Statistics of populations: factor analysis and the hypotheses of the paper."""
