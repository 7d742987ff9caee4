"""Canes that several tests use."""

from physics.reed.cane.material import Cane

# Nine different constants: none can replace another.
ODD_CANE = Cane(
    E_L_pa=13e9,
    E_T_pa=0.7e9,
    E_R_pa=0.9e9,
    G_LT_pa=1.1e9,
    G_LR_pa=1.3e9,
    G_TR_pa=0.25e9,
    nu_LT=0.35,
    nu_LR=0.25,
    nu_TR=0.45,
)
