"""A diagnosis of four frames that others recorded, with the observables that such frames have.

Their phase steps are 49, 57 and 68 degrees in place of 90, and the light becomes brighter by a
third (see `tests.peers.test_public_holograms`).
"""

import numpy as np
import pytest

from diagnosis.campaign_diagnosis import CampaignSummary, Diagnosis, diagnose_problem
from diagnosis.inference.nuisances import NUISANCES
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Observable
from diagnosis.observables.reed_at_rest import (
    phase_turn_group,
    stability_group,
    usual_scatter_hz,
)
from diagnosis.readings.reed_at_rest import RestHolograms
from holography.demodulation import measure_phase_steps
from holography.phase import TURN_OF_FRAMES
from physics.parameters.disorder import BY_NAME
from physics.parameters.optics import Interference
from physics.parameters.tree import BenchParameters
from tests.peers.test_public_holograms import read_hologram

# Camera of the paper; that of these frames is not known. Hz of the lock are in proportion to it.
RATE_HZ = 12.4


@pytest.fixture(scope="module")
def verdict() -> Diagnosis:
    frames = np.stack([read_hologram(f"I{m}_Fresnel_Lens.bmp") for m in range(4)])
    turn_rad = float(np.dot(TURN_OF_FRAMES, measure_phase_steps(frames).steps_rad)) - np.pi / 2
    bright, none = frames.reshape(4, -1).mean(axis=1), np.zeros(0)
    still = RestHolograms(
        clamping=0, time_s=np.zeros(1), advance_rad=np.array([turn_rad]),
        advance_error=np.array([0.01]), turn_rad=none, gap_s=none, brightness=np.zeros(1),
        frame_ratio=np.array([np.log((bright[1] + bright[3]) / (bright[0] + bright[2]))]),
        frame_scatter=float(1 / np.sqrt(2 * frames[0].size * bright.mean())),
        likeness=np.ones((1, 1)), likeness_error=0.0, run=np.zeros(1, dtype=np.intp),
        run_time_s=np.zeros(1), noise_dn2=np.ones(1),
    )  # fmt: skip
    ordinary = Interference(
        walk_rad_s=BY_NAME["path_walk"].ordinary.root_mean_square,
        jitter_rad=BY_NAME["path_jitter"].ordinary.root_mean_square,
    )
    groups = [
        phase_turn_group([still], usual_scatter_hz(ordinary, RATE_HZ), RATE_HZ),
        stability_group([still], none),
    ]
    return diagnose_problem(
        InferenceProblem(groups, BenchParameters(), NUISANCES[:1]), CampaignSummary()
    )


def test_the_frames_are_far_from_a_healthy_bench(verdict: Diagnosis) -> None:
    assert verdict.gap.first_failing is Observable.HOLOGRAM
    turn = verdict.gap.observables[Observable.HOLOGRAM]
    # 32 degrees, of which a phase that walks as on ordinary benches explains some two.
    assert 10 < turn.gap < 25
    assert verdict.probability["none"] < 1e-6


def test_one_acquisition_cannot_tell_unequal_steps_from_detuned_synthesizers(verdict) -> None:
    """Both turn the light; the light that becomes brighter neither of them explains."""
    single = verdict.selection.single
    for name in ("phase_step_error", "synthesizer_detuning"):
        gain = single[name].log_evidence - verdict.selection.null.log_evidence
        # Odds of more than 1000 to 1.
        assert gain > np.log(1000)
    assert set(verdict.compared) == {"phase_step_error", "synthesizer_detuning"}
    assert verdict.next_experiments[0].experiment.id
    assert verdict.kind == "unknown"
