"""A reduced basis that holds over a range of materials."""
