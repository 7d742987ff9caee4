"""All groups of the comparison, computed in one go."""

from dataclasses import dataclass
from typing import Any

from fitting.comparison.cane import compare_cane
from fitting.comparison.chain import compare_hypotheses
from fitting.comparison.correlations import compare_correlations
from fitting.comparison.factors import compare_factors
from fitting.comparison.findings import findings
from fitting.comparison.frequencies import compare_frequencies
from fitting.comparison.mesh_evidence import compare_meshes, gather_evidence
from fitting.comparison.metamodel import compare_metamodel, compute_network, reference_hz
from fitting.comparison.models import Announce, build_models
from fitting.comparison.out_of_reach import list_out_of_reach
from fitting.comparison.printed import printed
from fitting.comparison.rows import Group, Row, Verdict
from fitting.comparison.sensitivities import compare_sensitivities, compute_table_3
from fitting.comparison.shape import compare_shape
from fitting.comparison.sweep import compare_sweep
from physics.reed.geometry import ReedGeometry


@dataclass(frozen=True)
class Comparison:
    """The paper beside us.

    Attributes
    ----------
    groups : tuple of Group
    findings : tuple of str
        What they come to, in sentences.
    """

    groups: tuple[Group, ...]
    findings: tuple[str, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of all groups."""
        return tuple(row for group in self.groups for row in group.rows)

    def count(self, verdict: Verdict) -> int:
        """Rows with a verdict."""
        return sum(group.count(verdict) for group in self.groups)

    def to_json(self) -> dict[str, Any]:
        """Return all of it with stable keys."""
        return {
            "counts": {str(verdict): self.count(verdict) for verdict in Verdict},
            "findings": list(self.findings),
            "groups": [group.to_json() for group in self.groups],
        }


def compare_paper(announce: Announce) -> Comparison:
    """Compute everything that can be computed of the paper; takes about a minute.

    Parameters
    ----------
    announce : callable
        Told what is being waited for.
    """
    numbers = printed()
    models = build_models(announce)
    evidence = gather_evidence(announce)
    table_3 = compute_table_3(announce)
    network = compute_network(models.reed)
    announce("comparing synthetic populations")
    groups = (
        compare_sweep(numbers, models.adjusted),
        compare_shape(numbers, ReedGeometry()),
        compare_sensitivities(numbers, table_3, evidence),
        compare_metamodel(numbers, models, network, evidence),
        compare_meshes(numbers, evidence, reference_hz(models.table_9)),
        compare_frequencies(numbers, models),
        compare_factors(numbers, models),
        compare_hypotheses(numbers, models, announce),
        compare_cane(numbers, models),
        compare_correlations(numbers, models),
        list_out_of_reach(numbers),
    )
    return Comparison(groups, findings(row for group in groups for row in group.rows))
