"""How a reed answers to changes of its shape and structure."""
