"""From values of any kind to samples to refine, and what may be done with them.

What the user says of the values wins, then what the file says; the rest is recognised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import BoolArray, Triple
from ..errors import GridError
from ..options import Options
from .look import (
    MOST_NAMED,
    Extremes,
    Look,
    as_labels,
    beside_surface,
    border_share,
    look_at,
    named,
    typical_slope,
    which_level,
)
from .recognise import Answer, recognise
from .samples import (
    LEAST_SPACING,
    MOST_SPACING,
    MadePlanes,
    SampleArray,
    changed,
    check_spacing,
    is_cubic,
    steps_of,
)

INNER = 0.25  # spacings: as deep at least samples inside are, where parts of a solid touch
NONE_EXACT: Extremes = (0.0, 0.0)
FILLED = 1.75  # voxels: cut off nearer is filled in; volumes move by 1e-4 at 1.6, 1e-5 at 1.9
STEEPER = 1.3  # than between any neighbours: slopes to 1.22, beside edges of cut off ones 1.43
# Densities that level off within a voxel of the surface are distances: share of the values between
# their ends that are beside it. Volume fractions from .87, ramps over two voxels .74, blurred .33.
BESIDE = 0.6
APPROXIMATE = "from the values, so the size of the mesh is approximate (give --spacing)"
ORDINARY = 1e-100, 1e100  # sizes whose squares are numbers, too

Above: TypeAlias = Callable[[NDArray[Any]], BoolArray]
"""Which samples have the larger value of a mask."""


@dataclass(frozen=True, eq=False)
class Field:
    """What the values of a grid are, and what the steps may do with them."""

    kind: str = "distance"
    given: bool = False  # whether the user said so; otherwise it was recognised
    exact: Extremes = (-np.inf, np.inf)  # samples between these may be exact, negative inside
    network: str | None = "distance"  # that refines them; None: their own cubic spline is the field
    own_lattice: bool = False  # refined on the lattice of the samples, in steps of the finest one
    sides_only: bool = False  # only on which side the samples are is known
    has_jumps: bool = False  # where the spline would swing, values are interpolated linearly
    facts: dict[str, Any] = field(default_factory=dict)  # what was measured, for ``--json``
    unseen: SampleArray | None = None  # which may hide the surface: it ends there, and stays open
    why_open: str = ""  # a sentence on them

    @property
    def has_exact(self) -> bool:
        """Whether some samples may be exact distances."""
        return self.exact[0] < self.exact[1]

    def report(self) -> dict[str, Any]:
        """Return kind and facts as a dictionary that can be written as JSON."""
        known = {name: np.asarray(x, float) for name, x in self.facts.items() if x is not None}
        facts = {name: np.round(x, 4).tolist() for name, x in known.items()}
        return {"kind": self.kind, "given": self.given, **facts}


MASK = Field("mask", exact=NONE_EXACT, network="mask", sides_only=True)


@dataclass(eq=False)
class Case:
    """Values on their way to a grid: the steps change them, and add notes for the user."""

    samples: SampleArray
    look: Look
    wanted: Options
    spacing: Triple | None
    given: SampleArray  # the samples without level and scale: levels that are named are of these
    notes: list[str]
    facts: dict[str, Any] = field(default_factory=dict)
    unseen: BoolArray | None = None
    why_open: str = ""

    def taken(
        self, kind: Field, positive_inside: bool, extremes: Extremes | None = None
    ) -> dict[str, Any]:
        """Return the arguments with which a grid is made of the samples, negative inside."""
        samples, (low, high) = self.samples, extremes or (self.look.low, self.look.high)
        if positive_inside:
            floats = np.promote_types(samples.dtype, np.float32)  # unsigned integers have no sign
            samples = MadePlanes(samples, partial(np.negative, dtype=floats), dtype=floats)
            low, high = -high, -low
        given = self.wanted.field == kind.kind
        facts = {name: x for name, x in self.facts.items() if name != "spacing"}
        kind = replace(kind, given=given, facts=facts, unseen=self.unseen, why_open=self.why_open)
        place = {"spacing": self.spacing, "notes": tuple(self.notes)}
        return {"samples": samples, "extremes": (low, high), "field": kind, **place}

    def choose_side(self, above: Above | None = None) -> bool:
        """Whether positive values are inside, or those of a mask that are ``above``.

        Unless it is said, the border is outside.
        """
        if self.wanted.inside != "auto":
            return self.wanted.inside == "positive"
        if above is None and self.look.is_one_sided:
            return self.look.low < 0
        below = border_share(self.look, lambda x: ~above(x) if above else x < 0)
        positive, share = below > 0.5, max(below, 1 - below)
        if share < 1 or (positive and not above):
            names = ("the smaller value", "the larger value") if above else ("negative", "positive")
            self.notes.append(
                f"taken as inside: {names[positive]}; {share:.0%} of the grid's border is on the "
                "other side (if that is wrong, use --inside)"
            )
        return positive

    def set_spacing(self, spacing: float, why: str) -> None:
        """Take a spacing unless one is given, and say why."""
        if self.spacing is None:
            self.notes.append(f"spacing not given: taken as {spacing:.6g}, {why}")
            self.spacing = check_spacing(spacing)

    def scaled(self, slope: float) -> None:
        """Divide the samples by a slope."""
        self.samples = changed(self.samples, lambda planes: planes / slope)
        self.look = replace(self.look, low=self.look.low / slope, high=self.look.high / slope)
        self.facts = self.facts | {"cut": [x / slope for x in self.facts.get("cut", ())]}

    def clip_padding(self) -> None:
        """Clip an end of the values that is farther from all others than these are apart.

        A spline would swing beside it.
        """
        for end in (self.look.low, self.look.high):
            others = self.look.part[np.isfinite(self.look.part) & (self.look.part != end)]
            low, high = float(others.min(initial=0)), float(others.max(initial=0))
            if low < 0 < high and max(low - end, end - high) > high - low:
                self.samples = changed(self.samples, partial(np.clip, a_min=low, a_max=high))
                self.look = look_at(self.samples)
                seen = end / (self.wanted.scale or 1) + (self.wanted.level or 0)  # in the array
                self.notes.append(f"values of {seen:.6g}, far from all others, taken as padding")

    def fill_in(self, values: Sequence[float] = ()) -> None:
        """Fill in unknown samples, for which some values stand, too, if there are some."""
        low, high = self.look.low, self.look.high
        if self.look.is_two and 0 in (low, high) and self.wanted.inside == "auto":
            # the other value is inside, wherever it is
            self.wanted = replace(self.wanted, inside="positive" if high else "negative")
        if self.look.is_finite and not values:
            return
        from .unknown import with_known  # imported where it is needed, as few need it

        if self.look.is_two:  # a mask, whose values need not have two signs
            two = changed(self.samples, lambda x: np.where(np.isnan(x), x, 2 * (x > low) - 1))
            self.samples, self.look = two, look_at(two)
        filled = with_known(self.samples, self.look, values, self.notes)
        self.samples, self.unseen, self.why_open = filled
        self.look = look_at(self.samples)
        self.facts = self.facts | {"cut": [self.look.low, self.look.high]}


def interpret(
    samples: SampleArray, wanted: Options, spacing: ArrayLike | None, hint: str = ""
) -> dict[str, Any]:
    """Return what the values of a grid are taken as, as arguments of ``SdfGrid.trusted``.

    ``hint`` is a kind that the file states.
    """
    steps, notes = None if spacing is None else check_spacing(spacing), list[str]()
    if wanted.level is not None and wanted.inside == "auto" and hint == "distance":
        said = f"--level {wanted.level:g} is for densities, and the file states distances: give "
        raise GridError(f"{said}--offset {wanted.level * (wanted.scale or 1):g} instead")
    if wanted.inside == "auto" and (wanted.label is not None or wanted.level is not None):
        wanted = replace(wanted, inside="positive")
    if wanted.unknown is not None and samples.dtype.kind != "b":
        value = wanted.unknown
        samples = changed(samples, lambda planes: np.where(planes == value, np.nan, planes))
    if wanted.label is not None:
        labels, samples = samples, labelled(as_labels(samples), wanted.label)
    given = samples
    if wanted.level is not None:
        samples = changed(samples, partial(np.add, -float(wanted.level)))
        which = "below" if wanted.inside == "negative" else "above"
        notes.append(f"values {which} {wanted.level:g} are taken as inside (see --inside)")
    if wanted.scale is not None and samples.dtype.kind != "b":
        samples = changed(samples, partial(np.multiply, float(wanted.scale)))
    look = look_at(samples)
    if wanted.label is not None and look.low == look.high:
        values = {x.item() for plane in as_labels(labels) for x in np.unique(plane)[:MOST_NAMED]}
        which = f"{'every' if look.high > 0 else 'no'} sample has the label {wanted.label}"
        raise GridError(f"{which}: the labels are {named(values)}")
    check_size(look)
    case = Case(samples, look, wanted, steps, given, notes)
    if samples.dtype.kind == "b":
        return _of_mask(case, np.asarray)
    if wanted.level is not None:
        return _of_level(case)
    if wanted.field == "mask" or wanted.label is not None:
        case.fill_in()
        return _of_sides(case)
    h = None if steps is None else np.array(steps_of(steps))
    answer = Answer(wanted.field, "", {"cut": look.cut, "spacing": h})
    if wanted.field == "auto" or h is None:
        answer = recognise(samples, look, h, hint)
    if wanted.field != "auto":
        facts = {name: answer.facts.get(name) for name in ("cut", "spacing", "unit")}
        answer = Answer("mask" if look.is_two else wanted.field, "", facts)
    is_shell = answer.kind == "distance" and look.is_one_sided and wanted.inside != "auto"
    if answer.kind == "labels":
        raise GridError(answer.refusal)
    if answer.kind == "density" or (answer.refusal and not is_shell):
        raise _refused(case, answer.refusal)
    return _as_recognised(case, answer)


def check_size(look: Look) -> None:
    """Raise GridError unless there are different values, of a size with which one can calculate."""
    if look.low > look.high:
        raise GridError("no value is finite: there is no surface")
    if look.low == look.high:
        only = look.low if isinstance(look.low, bool) else f"{look.low:.6g}"
        raise GridError(f"every value is {only}: a constant field has no surface")
    end = max(look.high, look.low, key=abs)
    if not ORDINARY[0] < abs(end) < ORDINARY[1]:
        said = f"if it marks unknown samples, --unknown {end:.17g}, else scale the values, --scale"
        raise GridError(f"the largest value is {end:.6g}: {said}")


def _refused(case: Case, said: str = "") -> GridError:
    """Return the error for values that cannot be meshed; by default they need a level."""
    before, level, side = look_at(case.given), case.wanted.level or 0.0, ""
    value = "finite value" if before.infinite else "value"
    if case.look.low >= 0:
        side = f"no {value} is below {level:g} (the smallest is {before.low:.6g}): "
    elif case.look.high <= 0:
        side = f"no {value} is above {level:g} (the largest is {before.high:.6g}): "
    return GridError(side + (said or which_level(before)))


def _as_recognised(case: Case, answer: Answer) -> dict[str, Any]:
    """Return values that are taken as what they were recognised as."""
    case.facts = facts = answer.facts
    case.fill_in(facts.get("unknown_values", ()))
    if answer.kind == "mask":
        return _of_sides(case)
    if answer.kind == "smooth":
        if answer.why:
            how = "the surface is that of their cubic spline"
            case.notes.append(f"values taken as smooth (--field smooth), since {answer.why}: {how}")
        return _of_spline(case)
    if case.spacing is None:
        case.spacing = _estimated(case)
    if answer.kind == "noisy":
        said = f", of about {facts['noise']:.2g} voxels" if "noise" in facts else ""
        if case.wanted.field != "noisy":
            case.notes.append(f"values taken as noisy (--field noisy): {answer.why}{said}")
        return case.taken(Field("noisy", exact=NONE_EXACT, network="noisy"), case.choose_side())
    if slope := facts.get("slope"):
        case.notes.append(
            f"the values change by {slope:.4g} of a spacing from sample to sample, distances by 1: "
            f"the values are divided by that (if the spacing is wrong, give --spacing)"
        )
        case.scaled(slope)
    return _of_distances(case, case.spacing)


def labelled(samples: SampleArray, label: int) -> MadePlanes:
    """Return which samples have a label; of floats as 1 and -1, and NaN where they are unknown."""
    value: Any = np.nan  # equals no sample: a label that the type does not hold is not rounded
    with np.errstate(over="ignore"), suppress(OverflowError):
        nearest = np.array(label, object).astype(samples.dtype)
        value = nearest if int(nearest) == label else value
    if samples.dtype.kind != "f":
        return changed(samples, lambda planes: planes == value, np.bool_)
    return changed(samples, lambda x: np.where(np.isnan(x), x, 2 * (x == value) - 1), np.float32)


# Masks


def _of_sides(case: Case) -> dict[str, Any]:
    """Return the mask that the sides of values make; 0 is on the side ``zeros``, else inside."""
    look, inside, facts = case.look, case.wanted.inside, case.facts
    if look.is_two:
        return _of_mask(case, partial(np.less, look.low))
    if look.low > 0 or look.high < 0:
        raise _refused(case)
    if "step" in facts:
        case.notes.append("the values are a distance transform, of which only the signs are used")
        case.set_spacing(facts["step"], "the step of the transform")
    below, zeros = border_share(look, lambda x: x < 0), facts.get("zeros", 0)
    is_positive = below > 0.5 if inside == "auto" else inside == "positive"
    with_zeros = look.high == 0 or zeros > 0 or (look.low < 0 and zeros == 0 and is_positive)
    return _of_mask(case, partial(np.less_equal if with_zeros else np.less, 0))


def _of_mask(case: Case, above: Above) -> dict[str, Any]:
    """Return distances between the samples that are above and the others, on their lattice."""
    from .derived import REACH, extremes_of_masks, mask_distances

    positive = case.choose_side(above)
    case.set_spacing(1, "since a mask shows none (give --spacing)")
    said = "a mask shows the surface to half a voxel only"
    case.notes.append(f"values taken as a mask (--field mask): {said}")
    h = min(steps_of(case.spacing or (1, 1, 1)))
    case.samples = MadePlanes(
        case.samples, lambda x: mask_distances(above(x) == positive).astype(float) * h, REACH
    )
    return case.taken(MASK, False, extremes_of_masks(h))


# Densities, and fields with the surface of their spline


def _of_level(case: Case) -> dict[str, Any]:
    """Return values from which a level was taken, above it positive."""
    look, wanted = case.look, case.wanted
    if look.is_one_sided:
        raise _refused(case)
    case.fill_in()
    if look.is_two or wanted.field == "mask":
        return _of_mask(case, partial(np.less, 0))
    case.set_spacing(1, "since densities show none (give --spacing)")
    return _of_spline(case, "density")


def _of_spline(case: Case, kind: str = "smooth") -> dict[str, Any]:
    """Return values in steps of their slope beside the surface, to be meshed by their spline."""
    if case.look.is_one_sided:
        raise _refused(case)
    case.clip_padding()
    case.spacing = spacing = case.spacing or _estimated(case)
    steps = steps_of(spacing)
    slope = 1.0 if case.wanted.scale else _slope_at_surface(case.look, steps)
    if kind == "density" and is_cubic(spacing):
        between = (case.look.part > case.look.low) & (case.look.part < case.look.high)
        if (beside_surface(case.look.part) & between).sum() > BESIDE * between.sum():
            case.facts = {"cut": [case.look.low, case.look.high]}
            case.scaled(slope)
            return _of_distances(case, spacing, "density")
    case.scaled(slope)
    if "inside" in case.facts:
        from .derived import without_inner_faces

        case.samples = without_inner_faces(case.samples, case.facts["inside"], INNER * min(steps))
    has_jumps = bool(case.facts.get("cut")) and kind == "smooth"
    own = Field(kind, exact=NONE_EXACT, network=None, has_jumps=has_jumps)
    return case.taken(own, case.choose_side())


def _slope_at_surface(look: Look, steps: ArrayLike) -> float:
    """Return the typical slope beside the surface, in world units; of steps over 0 if unknown."""
    slope = typical_slope(look, np.array(steps), look.cut)
    steepest = float(np.abs(look.pairs[0] - look.pairs[1]).max(initial=0) / np.min(steps))
    return slope if slope < STEEPER * steepest else steepest or 1.0


# Distances


def _of_distances(case: Case, spacing: Triple, kind: str = "distance") -> dict[str, Any]:
    """Return distances, of which some may be cut off; what is missing is filled in if it helps."""
    look, cut, steps = case.look, case.facts["cut"], steps_of(spacing)
    positive = case.choose_side()
    low = look.low if look.low in cut and look.low < 0 else -np.inf
    high = look.high if look.high in cut and look.high > 0 else np.inf
    if min(-low, high) < FILLED * max(steps):
        from .derived import filled_planes

        case.notes.append("values that are cut off near the surface are filled in beyond")
        case.samples = filled_planes(case.samples, steps, (look.low, look.high))
    exact = (-high, -low) if positive else (low, high)
    return case.taken(Field(kind, exact=exact if kind == "distance" else NONE_EXACT), positive)


def _estimated(case: Case) -> Triple:
    """Return the spacing that the values show, with a note; GridError if they show none."""
    found = case.facts.get("spacing")
    if found is None:
        is_common = case.facts.get("slopes", 0) > 0.5  # else the surface may have another slope
        found = case.facts["unit"] if is_common else _slope_at_surface(case.look, np.ones(3))
    x, y, z = (np.ones(3) * found).tolist()
    if not LEAST_SPACING <= min(x, y, z) <= max(x, y, z) <= MOST_SPACING:
        said = f"spacing not given: the values change by {max(x, y, z):.6g} from sample to sample; "
        said += "give --spacing, in a unit in which it is between "
        raise GridError(f"{said}{LEAST_SPACING:g} and {MOST_SPACING:g}")
    shown = f"{x:.6g}" if x == y == z else f"{x:.6g}, {y:.6g}, {z:.6g} along x, y, z"
    case.notes.append(f"spacing not given: estimated as {shown} {APPROXIMATE}")
    return check_spacing((x, y, z))
