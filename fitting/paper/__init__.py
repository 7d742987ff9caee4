"""Numbers that the paper prints."""
