"""What a lens does to the light of an object at any distance: spots, fans, wavefront, point spread,
MTF, distortion, field curvature, colour, depth of field."""

from codesign.doors import explain
from codesign.lens.analysis.depth_of_field import (
    DepthOfField,
    depth_of_field,
    hyperfocal_m,
    traced_depth_of_field,
)
from codesign.lens.analysis.field_curves import (
    RayFan,
    chief_height_mm,
    chromatic_focus_shift_mm,
    distortion_percent,
    focus_shift_mm,
    lateral_colour_mm,
    ray_fan,
    through_focus_mtf,
    through_focus_spot_mm,
)
from codesign.lens.analysis.mtf import diffraction_mtf, geometric_mtf, ideal_mtf
from codesign.lens.analysis.psf import Psf, diffraction_psf, geometric_psf, psf_on_pixels
from codesign.lens.analysis.rays import (
    ImageRays,
    Light,
    chief_ray,
    field_rays,
    pupil_grid,
    spectral_lines,
    trace_field,
    working_fno,
)
from codesign.lens.analysis.spots import (
    encircled_energy,
    encircled_radius_mm,
    polychromatic_spot,
    rms_spot_mm,
    spot_radius_mm,
    spots,
)
from codesign.lens.analysis.wavefront import (
    Wavefront,
    peak_to_valley_waves,
    remove_fit,
    rms_waves,
    strehl_direct,
    strehl_marechal,
    wavefront,
)
from codesign.lens.diffraction.pupil import PupilFunction, pupil_function

__all__ = [
    "DepthOfField",
    "ImageRays",
    "Light",
    "Psf",
    "PupilFunction",
    "RayFan",
    "Wavefront",
    "chief_height_mm",
    "chief_ray",
    "chromatic_focus_shift_mm",
    "depth_of_field",
    "diffraction_mtf",
    "diffraction_psf",
    "distortion_percent",
    "encircled_energy",
    "encircled_radius_mm",
    "field_rays",
    "focus_shift_mm",
    "geometric_mtf",
    "geometric_psf",
    "hyperfocal_m",
    "ideal_mtf",
    "lateral_colour_mm",
    "peak_to_valley_waves",
    "polychromatic_spot",
    "psf_on_pixels",
    "pupil_function",
    "pupil_grid",
    "ray_fan",
    "remove_fit",
    "rms_spot_mm",
    "rms_waves",
    "spectral_lines",
    "spot_radius_mm",
    "spots",
    "strehl_direct",
    "strehl_marechal",
    "through_focus_mtf",
    "through_focus_spot_mm",
    "trace_field",
    "traced_depth_of_field",
    "wavefront",
    "working_fno",
]

explain(globals())
