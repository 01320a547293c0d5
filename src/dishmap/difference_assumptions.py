"""What a difference rests on, and what one camera cannot see, in plain sentences."""

from __future__ import annotations

from dishmap.difference.difference_map import Considered, DifferenceMap
from dishmap.difference_verdict import PPM, ppm, scale_open
from dishmap.verdict import id_list, number

# How large an expansion and a drift of the focal length are made up to say what they would do.
EXAMPLE_PPM = 10.0
WAYS = {
    "least_strain": "as a membrane does: points slide so that it strains the least",
    "normal": "along its normals: points do not slide",
    "axial": "along the boresight",
    "any": "with any smooth slide along the surface",
}
# What the learnt sizes are, with the factor to the unit in which they are shown.
SIZES = {
    "normal_mm": ("displacement along the normal", 1.0, "mm"),
    "slide_strain": ("strain by further slide", PPM, "ppm"),
    "rough_mm": ("rise of each target on its own", 1.0, "mm"),
    "print_strain": ("strain of each print on its own", PPM, "ppm"),
    "expansion": ("uniform expansion", PPM, "ppm"),
    "focal": ("focal drift", PPM, "ppm"),
}
STRAINS = {
    "rigid": "the surface was taken not to stretch, and prints to keep their size, as was given.",
    "free": "the size of prints was taken to say nothing of depth, as was given: prints may have stretched by any amount.",
}


def assumptions(joint: DifferenceMap, flat: bool) -> list[str]:
    """What the estimate rests on and what one camera cannot see, in sentences; flat: the nominal surface is a plane."""
    best = max(joint.considered, key=lambda c: c.weight)
    out = [_expansion_words(joint), _focal_words(joint), _strain_words(joint, best)]
    out += _smoothness_words(joint, best)
    if joint.priors.slide is not None and not joint.priors.still:
        out.append(f"The surface was taken to move {way_words(joint, best, flat)}, as was given.")
    if joint.priors.rigid_ids:
        out.append(f"Targets {id_list(joint.priors.rigid_ids)} were taken to sit on rigid parts; their motion is the rigid motion.")
    return [*out, *_unseen(joint)]


def _expansion_words(joint: DifferenceMap) -> str:
    found, assumed = ppm(joint.expansion), ppm(joint.expansion_assumed)
    if joint.priors.expansion_ppm is not None:
        return f"Expansion: {assumed} was given beforehand; with the photographs it is {found}."
    if scale_open(joint):
        return f"Expansion: nothing was said of it and the picture's scale changed, so {assumed} was assumed; it is {found}."
    depth = EXAMPLE_PPM / PPM * float(joint.camera_from_dish.translation_mm[2])
    return (
        "Expansion: none was assumed, as nothing was said of it and the scale of the picture hardly changed. An expansion by "
        f"{EXAMPLE_PPM:g} ppm would pass for a motion of {number(depth)} mm towards the camera."
    )


def _focal_words(joint: DifferenceMap) -> str:
    sigma = joint.priors.focal_drift
    if sigma > 0:
        found = ppm(joint.focal_drift)
        return f"Focal length: a drift of 0 ± {number(PPM * sigma)} ppm was allowed for; with the photographs it is {found}."
    depth = EXAMPLE_PPM / PPM * float(joint.camera_from_dish.translation_mm[2])
    return (
        f"Focal length: taken as unchanged. A drift of {EXAMPLE_PPM:g} ppm (the camera warms up) would pass for a motion of "
        f"{number(depth)} mm along the line of sight."
    )


def _strain_words(joint: DifferenceMap, best: Considered) -> str:
    strain = joint.priors.strain
    if joint.priors.still:
        return "Strain: the surface was taken to move as a rigid body, as was given, so that it neither bends nor stretches."
    if isinstance(strain, str):
        return f"Strain: {STRAINS[strain]}"
    slide, prints = (f"{number(PPM * best.sizes[name])} ppm" for name in ("slide_strain", "print_strain"))
    if strain is not None:
        return f"Strain: a standard deviation of {slide} was given."
    return f"Strain: learnt from the photographs. Prints stretched by {prints} each on its own, and the slide added {slide} (rms)."


def _smoothness_words(joint: DifferenceMap, best: Considered) -> list[str]:
    if joint.priors.still:
        return []
    far = "given" if joint.priors.amplitude_mm is not None else "learnt"
    long = "given" if joint.priors.length_mm is not None else "weighed"
    return [
        f"Smoothness: displacement of {number(best.sizes['normal_mm'])} mm ({far}) that changes over {number(best.length_mm)} mm ({long}; "
        "values of the best way of moving). A sharper bend between targets would go unseen, and no sigma holds it."
    ]


def _unseen(joint: DifferenceMap) -> list[str]:
    return [
        "One camera cannot tell a motion of the surface from one of the camera: the rigid motion is that of one relative to the other.",
        "It sees depth by the size of prints. What enlarges all of them alike (expansion, a longer focal length) looks like an approach; "
        "what stretches one print looks like an approach of that target, and its neighbours are all that speaks against it.",
    ]


def way_words(joint: DifferenceMap, one: Considered, flat: bool) -> str:
    """One way of moving in plain words; flat: the nominal surface is a plane."""
    if joint.priors.still:
        return "as a rigid body"
    if flat and one.way != "any":
        return "in and out; on a plane that makes no point slide"
    return WAYS[one.way]
