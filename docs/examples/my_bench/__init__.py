"""Template of drivers: copy this folder, rename it, and edit one file for each instrument."""
