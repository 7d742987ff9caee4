"""The paper's hypotheses H1 … H11 of how a population of reeds is made, fitted and compared."""
