"""The material of a reed: elastic constants, viscoelasticity, condition."""
