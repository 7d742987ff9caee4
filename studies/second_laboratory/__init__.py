"""A laboratory that the fit has never seen: a second simulator of the reed bench, for tests only.

It answers how true the stated errors of a fit, and the verdicts of a diagnosis, are on data from a
generator that shares no code with them. It was written from the paper, from physics and from the
literature, without reading the project's models, fits or diagnosis; import-linter keeps it apart.
No number of the project comes from it, but errors of the fit, and their causes, were looked for
with its reeds 1 to 500. Those from 501 on are for scores: nothing was changed for what they show.

::

    python -m studies.second_laboratory --reeds 24 --series A B --folder reeds
    python -m studies.second_laboratory --reeds 24 --series A B --folder reeds --fit-only
    python -m studies.second_laboratory.convergence

It is played through the driver interfaces: `bench.bench_file` returns a bench whose three
instruments are those of `instruments`, and `acquire.run` makes an ordinary run file with it.

Its parts
    ========================  ====================================================================
    elements, shape           triangular prisms, cubic in plan, graded to the edges of the strips;
                              both halves of the reed
    cane                      E_L and G_LT after hypothesis H4, one loss factor for Young's moduli
                              and one for shear moduli
    air                       doublet panels with retardation: inertia and radiation of a plate
                              without a baffle, free air on both sides
    reed                      reduced model of order about 60; poles with air, clamp and
                              moduli of their own frequency; forced response
    drive                     tweeter with poles, the resonance at 4308.6 Hz, standing and
                              travelling pressure, clay in one half, rails
    light                     scatterers anywhere, uneven-to-even transform; all orders of the
                              vibration, and the object's own speckle, in each frame
    laboratory, instruments   sensor, ageing of field and path, clock, drivers
    campaigns                 all runs of one reed in a quarter of an hour, and what may be wrong
    ========================  ====================================================================

Disorder, each with its range and source, is the table of fields in `parameters.Disorder`; an amount
of 0 switches a field off, ``all=0`` all that are not named.

What it leaves out
    The air of the chamber and the mouthpiece's walls (the reed vibrates in free air, so its added
    mass is that of a free plate: F1 −39, T1 −25, F4 −18 cents), thermoviscous losses, transients
    after a new setting, changes of temperature within a sweep, slopes of the surface in the optics,
    and the change of the pixel's blur with the pixel's place (below 2 % on the small sensor).
    X4 … X6 are names of this package's own choice: modes above 16 kHz are not scored.
"""
