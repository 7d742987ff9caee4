"""Campaigns of the second laboratory: all runs of one reed in a quarter of an hour, with hands.

Here are scenes, clampings, slow drifts, levels of disorder, and effects: things that are wrong in
addition to disorder. A recording shows nothing of its case but physics.

::

    case = draw_case("single", "ordinary", seed=1, number=7)
    record(case, Path("measurements/case-7"))
    truth = truth_of(case)

Its parts
    ========================  ====================================================================
    disorder, drawing         ranges that a sweep lacks, levels, parameters of a bench
    effects                   one class for each effect; `effects.catalogue` lists them
    case                      cases, and the generators of random numbers that keep them apart
    climate, motion           what wanders slowly; vibration at one moment
    image, sensor             light of one clamping on the sensor; camera
    world                     scenes, hands, exposures
    truth                     what is true of a case, for whoever judges answers
    instruments, recording    drivers, and campaigns by `acquire`
    ========================  ====================================================================

What it leaves out, in addition to what sweeps leave out
    Changes of temperature within the four frames of a hologram, the sound of the chamber at
    another temperature, and changes of the patterns of sensor and lamp within a campaign.
"""
