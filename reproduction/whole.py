"""All groups of the comparison, computed in one go."""

from dataclasses import dataclass
from typing import Any

from fitting.paper.printed import printed
from physics.reed.geometry import ReedGeometry
from reproduction.findings import findings
from reproduction.groups.cane import compare_cane
from reproduction.groups.chain import compare_hypotheses
from reproduction.groups.correlations import compare_correlations
from reproduction.groups.factors import compare_factors
from reproduction.groups.frequencies import compare_frequencies
from reproduction.groups.mesh_evidence import compare_meshes, gather_evidence
from reproduction.groups.metamodel import (
    compare_metamodel,
    compute_network,
    reference_hz,
)
from reproduction.groups.sensitivities import compare_sensitivities, compute_table_3
from reproduction.groups.shape import compare_shape
from reproduction.groups.sweep import compare_sweep
from reproduction.models import Announce, build_models
from reproduction.out_of_reach import list_out_of_reach
from reproduction.rows import (
    Agreement,
    Group,
    Row,
)


@dataclass(frozen=True)
class PaperComparison:
    """Comparison of all printed numbers with ours.

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

    def count(self, agreement: Agreement) -> int:
        """Rows with a agreement."""
        return sum(group.count(agreement) for group in self.groups)

    def to_json(self) -> dict[str, Any]:
        """Return all of it with stable keys."""
        return {
            "counts": {str(agreement): self.count(agreement) for agreement in Agreement},
            "findings": list(self.findings),
            "groups": [group.to_json() for group in self.groups],
        }


def compare_paper(announce: Announce) -> PaperComparison:
    """Compute everything that can be computed of the paper; takes about a minute.

    Parameters
    ----------
    announce : callable
        Called with what is being waited for.
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
    return PaperComparison(groups, findings(row for group in groups for row in group.rows))
