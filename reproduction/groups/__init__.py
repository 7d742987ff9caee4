"""The paper's numbers beside ours, one module for each group of numbers."""
