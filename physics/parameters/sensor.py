"""Parameters of the camera's sensor."""

from dataclasses import dataclass

from physics.parameters.quantity import quantity

_SHEET = "data sheets of CCD cameras of 1.3 megapixels, 12 bit"


@dataclass(frozen=True)
class Sensor:
    """A CCD with shot noise, read noise, a full well and an ADC.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns.
    pixel_m : float
        Pixel pitch.
    full_well_e : float
        Electrons at which a pixel stops filling.
    gain_e_dn : float
        Electrons per digital number.
    read_noise_e : float
        Standard deviation of the read noise per pixel and frame, in electrons.
    offset_dn : float
        Digital number of a dark pixel.
    bits : int
        Resolution of the ADC.
    pattern : float
        Standard deviation of the pixels' relative sensitivity, always the same for one sensor.
    hot : float
        Fraction of hot pixels.
    row_noise_e : float
        Standard deviation of an offset that all pixels of a row share in one frame, in electrons.
    lag : float
        Fraction of the light of the frame before that is read out with a frame; this frame keeps as
        much for the next one.
    nonlinearity : float
        Relative error of a full pixel, which reads too low; the error is proportional to the
        signal.
    """

    shape: tuple[int, int] = (1024, 1280)
    pixel_m: float = quantity(6.7e-6, "m", 1e-6, 30e-6, _SHEET)
    full_well_e: float = quantity(16000.0, "electrons", 1e3, 1e15, _SHEET)
    gain_e_dn: float = quantity(4.0, "electrons/dn", 0.05, 1e12, _SHEET)
    read_noise_e: float = quantity(12.0, "electrons", 0.0, 100.0, _SHEET)
    offset_dn: float = quantity(50.0, "dn", 0.0, 1e4, _SHEET)
    bits: int = 12
    pattern: float = quantity(0.0, "", 0.0, 0.05, "EMVA 1288 sheets: PRNU of 0.2 to 2 %")
    hot: float = quantity(0.0, "", 0.0, 0.01, "uncooled sensors of some years: up to 0.1 %")
    row_noise_e: float = quantity(
        0.0, "electrons", 0.0, 50.0, "EMVA 1288 sheets with row spectra: below the read noise"
    )
    lag: float = quantity(0.0, "", 0.0, 0.1, "charge that a CCD leaves behind: 0.1 to 1 %")
    nonlinearity: float = quantity(0.0, "", -0.05, 0.2, "EMVA 1288 sheets: 0.1 to 2 %")
