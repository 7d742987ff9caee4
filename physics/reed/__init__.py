"""The reed: shape, orthotropic elasticity, finite elements, modes and viscoelastic cane."""
