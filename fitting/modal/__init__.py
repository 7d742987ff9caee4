"""Joint fit of modes to all holograms of a sweep."""
