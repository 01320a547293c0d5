"""What an analysis of gain rests on, in plain sentences."""

from __future__ import annotations

from dishmap.rf.analysis import SHAPED, RfAnalysis
from dishmap.rf.antenna import Antenna
from dishmap.rf_verdict import QUANTITIES, what_moves

POINTINGS = {
    "free": "the antenna is pointed anew in every state, so gain counts at the beam's peak",
    "fixed": "the antenna keeps its pointing, so gain counts on the boresight",
}
KINDS = {"cassegrain": "Cassegrain", "gregorian": "Gregorian"}
NOT_MODELLED = (
    "Diffraction at the rim of the subreflector: rays are those of geometrical optics up to the dish. Where the subreflector is under "
    "about "
    "10 wavelengths across, gain and far sidelobes differ from these.",
    "The feed's own radiation past the subreflector or the dish: it is counted as lost (spillover), and is not in the pattern.",
    "Reflections back and forth between dish, subreflector and feed, and the feed's change of match.",
    "Losses in metal, mesh, paint or membrane, and power that passes through a mesh.",
    "Scattering at struts: they cast shadows along the boresight, from the plane wave only.",
)


def assumptions(analysis: RfAnalysis) -> list[str]:
    """What was taken for granted."""
    pointing, field = POINTINGS[analysis.options.pointing], analysis.field
    out = [
        antenna_words(analysis.antenna),
        f"Deformation: {QUANTITIES[analysis.quantity]}, from {len(field.places_mm)} targets that lie about {field.spacing_mm:.3g} mm "
        f"apart, "
        f"written in {len(field.terms)} Zernike terms over the aperture. Ripples shorter than twice that distance are not in it.",
        f"Pointing: {pointing}. A constant path (piston) does not matter.",
        f"Gain is co-polar, over the feed's whole power. Sigmas are the spread of {analysis.options.draws} surfaces drawn from the map's "
        f"covariance "
        f"(seed {analysis.options.seed}): an uncertain map costs gain on average, so that their middle may lie below the value.",
        "Efficiency by ray tracing to the dish and physical optics on it, with full phase; Ruze's estimate from the illumination-weighted "
        "half-path error stands beside it as a cross-check. It overstates the loss of smooth errors where they are large.",
    ]
    if analysis.corrections:
        out.append(
            f"Corrections hold the {what_moves(analysis)} within its strokes and serve all frequencies at once: the mean gain in dB is "
            f"largest."
        )
    if SHAPED in analysis.corrections:
        out.append(
            "A bend is asked to correct phases: it is sought with the illumination held as designed, degree by degree. Of all bends found "
            "and the rigid pose, the one with the largest gain is taken."
        )
    return out


def antenna_words(antenna: Antenna) -> str:
    """The antenna in one sentence."""
    main, feed, sub = antenna.reflector, antenna.feed, antenna.subreflector
    offset = f", offset by {main.offset_mm:g} mm along x" if main.offset_mm else ""
    kind = "prime focus" if sub is None else f"{KINDS[sub.kind]} of magnification {sub.magnification:g}"
    taper = "" if feed.edge_taper_db is None else f", {feed.edge_taper_db:g} dB down at the rim"
    taper += "" if feed.exponent is None else f" to the power {feed.exponent:g}"
    return (
        f"Antenna: paraboloid of {main.diameter_mm:g} mm diameter and {main.focal_length_mm:g} mm focal length "
        f"(f/D {main.focal_length_mm / main.diameter_mm:.3g}){offset}; {kind}; feed `{feed.kind}`{taper}, polarisation {feed.polarization}."
    )
