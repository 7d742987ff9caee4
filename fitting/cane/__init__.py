"""Material parameters of the cane from resonances."""
