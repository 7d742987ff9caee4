"""The paper's numbers compared with ours, one module for each group of numbers."""
