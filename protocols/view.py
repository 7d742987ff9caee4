"""Geometry of the image: frame shape, object plane and the position of the reed in it."""

from holography.fresnel import FresnelTransform
from physics.parameters.optics import Layout, visible_size_m
from protocols.bench import BenchFile
from protocols.protocol import (
    Protocol,
)
from protocols.reed import ReedFile


def frame_shape(protocol: Protocol, bench: BenchFile) -> tuple[int, int]:
    """Return rows and columns ``(ny, nx)`` of one frame: the sensor, or its middle part."""
    sensor, asked = bench.instruments.camera, protocol.camera
    return (asked.height or sensor.height, asked.width or sensor.width)


def object_transform(protocol: Protocol, bench: BenchFile) -> FresnelTransform:
    """Return the transform between the used part of the sensor and the object plane."""
    return FresnelTransform(
        shape=frame_shape(protocol, bench),
        pixel_m=float(bench.instruments.camera.pixel_m),
        wavelength_m=float(bench.optics.wavelength_m),
        distance_m=float(bench.optics.distance_m),
    )


def layout_of(bench: BenchFile, reed: ReedFile) -> Layout:
    """Return the position of the reed, and the size of the part of its image that is kept."""
    optics, size = bench.optics, bench.optics.reed_size
    return Layout(
        wavelength_m=float(optics.wavelength_m),
        distance_m=float(optics.distance_m),
        reed_centre_m=(float(optics.reed_centre.y_m), float(optics.reed_centre.x_m)),
        reed_size_m=(
            (float(size.y_m), float(size.x_m)) if size else visible_size_m(reed.geometry())
        ),
    )
