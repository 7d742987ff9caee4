"""The paper's way: resonances from the pictures with most fringes."""
