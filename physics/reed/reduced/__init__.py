"""One reduced-order reed: for the bench, the fit, the populations and the diagnosis."""
