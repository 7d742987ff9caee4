"""What the tests of the twin share: two reeds, box meshes, and a bench without noise."""

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator

from holography.demodulation import four_phase
from physics.bench import (
    BenchModel,
    BenchState,
    Segment,
)
from physics.motion import PlainMotion
from physics.parameters.chamber import Chamber, Filling
from physics.parameters.optics import Illumination, Optics
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters
from physics.reed.elements.fem import assemble
from physics.reed.elements.mesh import (
    STANDARD,
    HalfReedMesh,
    MeshLevel,
    build_mesh,
    lobatto_points,
)
from physics.reed.geometry import ReedGeometry
from physics.reed.reduced.stored import reduced_reed

FRAME_RATE_HZ = Fraction(25, 2)


@pytest.fixture(scope="session")
def geometry():
    return ReedGeometry()


@pytest.fixture(scope="session")
def coarse_level():
    return MeshLevel(orders=(2, 2, 2))


@pytest.fixture(scope="session")
def coarse_mesh(geometry, coarse_level):
    return build_mesh(geometry, coarse_level)


@pytest.fixture(scope="session")
def coarse_matrices(coarse_mesh):
    return assemble(coarse_mesh)


@pytest.fixture(scope="session")
def coarse_reed(geometry, coarse_level):
    return reduced_reed(geometry, coarse_level)


@pytest.fixture(scope="session")
def standard_reed():
    return reduced_reed()


@pytest.fixture(scope="session")
def standard_mesh(geometry):
    return build_mesh(geometry, STANDARD)


@pytest.fixture(scope="session")
def standard_matrices(standard_mesh):
    return assemble(standard_mesh)


@pytest.fixture(scope="session")
def consistent_load():
    """Return a function that integrates ``∫ N_a p dA`` over the flat side of a mesh, (n,).

    Gauss's rule of order 8 in every face, shape functions from scipy's interpolator.
    """

    def integrate(mesh, pressure):
        points, weights = np.polynomial.legendre.leggauss(8)
        points, weights = 0.5 * (1 + points), 0.5 * weights
        tables = []
        for order in mesh.orders[:2]:
            lagrange = BarycentricInterpolator(lobatto_points(order), np.eye(order + 1))
            tables.append((lagrange(points), lagrange.derivative(points)))
        (to_x, slope_x), (to_y, slope_y) = tables
        load = np.zeros(len(mesh.nodes_m), dtype=complex)
        for element in mesh.elements.reshape(-1, *(order + 1 for order in mesh.orders)):
            face = element[:, :, 0]
            plan = mesh.nodes_m[face]
            if plan[..., 2].max() > 0:
                continue
            x, y, _ = np.einsum("pa,qb,abc->cpq", to_x, to_y, plan)
            along = np.einsum("pa,qb,abc->cpq", slope_x, to_y, plan)
            across = np.einsum("pa,qb,abc->cpq", to_x, slope_y, plan)
            area = along[0] * across[1] - along[1] * across[0]
            weighted = pressure(x, y) * area * np.outer(weights, weights)
            load[face] += np.einsum("pa,qb,pq->ab", to_x, to_y, weighted)
        return load

    return integrate


@pytest.fixture(scope="session")
def box_mesh():
    """Return a maker of half boxes, ``0 ≤ x ≤ lx, 0 ≤ y ≤ ly, 0 ≤ z ≤ lz``, cut at y = 0."""

    def make(lengths_m, divisions, orders, clamped=None):
        axes = []
        for length, count, order in zip(lengths_m, divisions, orders, strict=True):
            inner = lobatto_points(order)[:-1]
            axes.append(length * np.append((np.arange(count)[:, None] + inner).ravel(), count))
            axes[-1] /= count
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        block = tuple(len(axis) for axis in axes)
        index = np.arange(len(nodes)).reshape(block)
        elements = [
            index[
                tuple(slice(p * k, p * k + p + 1) for p, k in zip(orders, place, strict=True))
            ].ravel()
            for place in np.ndindex(*divisions)
        ]
        held = np.zeros(len(nodes), dtype=bool) if clamped is None else clamped(*nodes.T)
        return HalfReedMesh(nodes, block, np.array(elements), orders, held, nodes[:, 1] == 0)

    return make


@pytest.fixture(scope="session")
def quiet_settings():
    """A small bench with so much light that only rounding to 16 bits is left of the noise.

    The local oscillator is flat, and the light of the object stands to it as on the nominal bench.
    """
    nominal, light_e_s = Illumination(), 80e12
    share = nominal.object_e_s / nominal.local_oscillator_e_s
    return BenchParameters(
        chamber=Chamber(Filling.ASYMMETRIC),
        optics=Optics(
            illumination=Illumination(
                local_oscillator_e_s=light_e_s,
                local_oscillator_waist_m=1e3,
                object_e_s=share * light_e_s,
            )
        ),
        sensor=Sensor(
            shape=(256, 320),
            full_well_e=1e15,
            gain_e_dn=light_e_s / float(FRAME_RATE_HZ) / 28e3,
            read_noise_e=0.0,
            offset_dn=0.0,
            bits=16,
        ),
    )


@pytest.fixture(scope="session")
def quiet_bench(quiet_settings, coarse_reed):
    return BenchModel(quiet_settings, PlainMotion(coarse_reed), np.random.default_rng(1))


@pytest.fixture(scope="session")
def take_frames():
    """Return a function that takes four consecutive frames of full exposure, (4, ny, nx)."""

    def take(bench, difference_hz, drive_hz=Fraction(0), drive_v=0.0, frame_rate_hz=FRAME_RATE_HZ):
        state = BenchState(Fraction(difference_hz), Fraction(drive_hz), drive_v)
        edges_s = [float(m / Fraction(frame_rate_hz)) for m in range(5)]
        rng = np.random.default_rng(2)
        return np.stack(
            [
                bench.frame([Segment(start_s, end_s, state)], rng)
                for start_s, end_s in pairwise(edges_s)
            ]
        )

    return take


@pytest.fixture(scope="session")
def take_field(take_frames):
    """Return a function that takes four frames and gives the field around the reed."""

    def take(bench, *args, **settings):
        hologram = four_phase(take_frames(bench, *args, **settings))
        return bench.region.crop(bench.transform.to_object(hologram))

    return take
