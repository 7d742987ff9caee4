"""Serial lines, VISA sessions and host names that drivers talk through."""
