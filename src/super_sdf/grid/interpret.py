"""From values of any kind to samples to refine, and what may be done with them.

What the user says of the values wins, then what the file says; the rest is recognised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Triple
from ..errors import GridError
from ..options import Options
from .look import (
    Extremes,
    Floats,
    Look,
    as_labels,
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
    SampleArray,
    changed,
    check_kind,
    check_spacing,
    is_cubic,
    steps_of,
)

if TYPE_CHECKING:
    from .unknown import Known

INNER = 0.25  # spacings: as deep at least samples inside are, where parts of a solid touch
NONE_EXACT: Extremes = (0.0, 0.0)
DENSITY = "density"  # what values with a level are
# Voxels from the surface at which values are cut off: where the rest is filled in, and below which
# too few are left for that.
FILLED, TOO_NEAR = 1.75, 0.85
SNAP = 0.02  # a spacing this close to a usual one is taken as that
UNEQUAL = 1.01  # ratio from which spacings that the values show differ
APPROXIMATE = "from the values, so the size of the mesh is approximate (give --spacing)"
ORDINARY = 1e-100, 1e100  # sizes whose squares are numbers, too


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


@dataclass(frozen=True, eq=False)
class Case:
    """Samples, what they look like, what the user says of them, and sentences for the user."""

    samples: SampleArray
    look: Look
    wanted: Options
    spacing: Triple | None
    notes: list[str]
    known: Known | None = None

    def choose_side(self) -> bool:
        """Whether values are positive inside; unless it is said, the border is outside."""
        if self.wanted.inside != "auto":
            return self.wanted.inside == "positive"
        if self.look.is_one_sided:
            return self.look.low < 0
        below = border_share(self.look, lambda x: x < 0)
        positive, share = below > 0.5, max(below, 1 - below)
        if positive or share < 1:
            sign = "positive" if positive else "negative"
            self.notes.append(
                f"{sign} values are taken as inside: {share:.0%} of the grid's border has the "
                "other sign (if that is wrong, use --inside)"
            )
        return positive

    def spacing_or(self, spacing: float, why: str) -> Triple:
        """Return the spacing that is given, else another, and why in a note."""
        if self.spacing is not None:
            return self.spacing
        self.notes.append(f"spacing not given: taken as {spacing:.6g}, {why}")
        return check_spacing(spacing)

    def taken(
        self, spacing: Triple, field: Field, facts: dict[str, Any], **more: Any
    ) -> dict[str, Any]:
        """Return the arguments with which a grid is made of the samples."""
        facts = {name: x for name, x in facts.items() if name != "spacing"}
        field = replace(field, facts=facts, given=self.wanted.field == field.kind)
        if self.known is not None and self.known.unseen is not None:
            field = replace(field, unseen=self.known.unseen, why_open=self.known.why_open)
        if "positive_inside" not in more:
            more["positive_inside"] = self.choose_side()
        kept = {"values": self.samples, "extremes": (self.look.low, self.look.high)}
        return {**kept, **more, "spacing": spacing, "field": field, "notes": tuple(self.notes)}


def interpret(
    samples: SampleArray, wanted: Options, spacing: ArrayLike | None, hint: str = ""
) -> dict[str, Any]:
    """Return what the values of a grid are taken as, as arguments of ``SdfGrid.trusted``.

    ``hint`` is a kind that the file states.
    """
    steps = None if spacing is None else check_spacing(spacing)
    check_kind(samples.dtype, samples.shape)
    notes: list[str] = []
    if wanted.inside == "auto" and (wanted.label is not None or wanted.level is not None):
        wanted = replace(wanted, inside="positive")
    if wanted.label is not None:
        samples = labelled(as_labels(samples), wanted.label)
    if wanted.unknown is not None and samples.dtype.kind != "b":
        value = wanted.unknown
        samples = changed(samples, lambda planes: np.where(planes == value, np.nan, planes))
    given = samples
    if wanted.level is not None:
        samples = changed(samples, partial(np.add, -float(wanted.level)))
        which = "below" if wanted.inside == "negative" else "above"
        notes.append(f"values {which} {wanted.level:g} are taken as inside (see --inside)")
    if wanted.scale is not None and samples.dtype.kind != "b":
        samples = changed(samples, partial(np.multiply, float(wanted.scale)))
    case = Case(samples, look_at(samples), wanted, steps, notes)
    look = case.look
    _check_size(look)
    if samples.dtype.kind == "b":
        return _of_mask(case, samples)
    if look.infinite:
        from .unknown import check_infinite  # imported where they are needed, as few are

        check_infinite(samples)
    if wanted.level is not None:
        return _of_level(case, given)
    if wanted.field == "mask":
        return _of_sides(case if look.is_finite else _with_known(case), {}, given)
    steps_given = None if steps is None else np.array(steps_of(steps))
    answer = Answer(wanted.field, "", {"cut": look.cut, "spacing": steps_given})
    if wanted.field == "auto":
        answer = recognise(samples, look, steps_given, hint)
    elif look.is_two:
        answer = Answer("mask", "there are two values", answer.facts)
    if answer.refusal and not (
        answer.kind == "distance" and wanted.inside != "auto" and look.is_one_sided
    ):
        raise _refused(answer, look, given if wanted.scale else None)
    return _as_recognised(case, answer, given)


def _check_size(look: Look) -> None:
    """Raise GridError unless there are different values, of a size with which one can calculate."""
    if look.low > look.high:
        raise GridError("no value is finite: there is no surface")
    if look.low == look.high:
        only = look.low if isinstance(look.low, bool) else f"{look.low:.6g}"
        raise GridError(f"every value is {only}: a constant field has no surface")
    largest = max(abs(look.low), abs(look.high))
    if not ORDINARY[0] < largest < ORDINARY[1]:
        end = look.high if look.high == largest else look.low
        said = f"if it stands for unknown ones, --unknown {end:.17g}, else multiply them, --scale"
        raise GridError(f"the largest value is {end:.6g}: {said}")


def _refused(answer: Answer, look: Look, given: SampleArray | None) -> GridError:
    """Return the error for values that cannot be meshed; they were ``given`` with another scale."""
    said, side = answer.refusal, ""
    if answer.kind == DENSITY and given is not None:  # a level is one of these values
        said = which_level(look_at(given), signed=not look.is_one_sided)
    if look.is_one_sided:
        which = (
            ("below", "smallest", look.low) if look.low >= 0 else ("above", "largest", look.high)
        )
        side = "no value is {} 0 (the {} is {:.6g}): ".format(*which)
    return GridError(("no solid is chosen: " if answer.kind == "labels" else side) + said)


def _as_recognised(case: Case, answer: Answer, given: SampleArray) -> dict[str, Any]:
    wanted, facts = case.wanted, answer.facts
    if not case.look.is_finite or "unknown_values" in facts:
        case = _with_known(case, facts.get("unknown_values", ()))
    if answer.kind == "mask":
        if "two values" not in answer.why:
            case.notes.append(f"the values are {answer.why}")
        return _of_sides(case, facts, given)
    if answer.kind == "smooth":
        if answer.why:
            case.notes.append(
                f"values taken as smooth (--field smooth), since {answer.why}: the surface is that "
                "of their cubic spline"
            )
        return _of_spline(case, facts, given)
    if case.spacing is None:
        case = replace(case, spacing=_estimated(case, facts))
    assert case.spacing is not None
    if answer.kind == "noisy":
        said = f", of about {facts['noise']:.2g} voxels" if "noise" in facts else ""
        if wanted.field != "noisy":
            case.notes.append(f"values taken as noisy (--field noisy): {answer.why}{said}")
        return case.taken(case.spacing, Field("noisy", exact=NONE_EXACT, network="noisy"), facts)
    if slope := facts.get("slope"):
        case.notes.append(
            f"the values change by {slope:.4g} of a spacing from sample to sample, distances by 1: "
            f"they are divided by that (if the spacing is wrong, give --spacing)"
        )
        samples, look = changed(case.samples, lambda values: values / slope), case.look
        look = replace(look, low=look.low / slope, high=look.high / slope)
        case = replace(case, samples=samples, look=look)
        facts = facts | {"cut": [x / slope for x in facts["cut"]]}
    return _of_distances(case, facts)


def _with_known(case: Case, values: Sequence[float] = ()) -> Case:
    """Return samples of which unknown ones are filled in."""
    from .unknown import with_known

    known = with_known(case.samples, case.look, values, case.notes)
    look = replace(look_at(known.samples), low=known.extremes[0], high=known.extremes[1])
    return replace(case, samples=known.samples, look=look, known=known)


def labelled(samples: SampleArray, label: int) -> SampleArray:
    """Return which samples have a label; GridError if none or all have."""
    value = as_sample(label, samples.dtype)
    found, others = False, False
    labels: set[Any] = set()
    for plane in samples:
        has = np.asarray(plane == value if value is not None else np.zeros(plane.shape, bool))
        found, others = found or bool(has.any()), others or not has.all()
        if not (found and others):
            labels |= {x.item() for x in np.unique(plane)[:9]}
    if found and others:
        return changed(samples, partial(np.equal, value), np.bool_)
    raise GridError(
        f"{'every' if found else 'no'} sample has the label {label}: the labels are {named(labels)}"
    )


def as_sample(label: int, dtype: np.dtype[Any]) -> Any:
    """Return the sample that is exactly a label, None if the type has none."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            value = dtype.type(label)
        return value if np.isfinite(value) and int(value) == label else None
    low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    return dtype.type(label) if low <= label <= high else None


# Masks


def _of_sides(case: Case, facts: dict[str, Any], given: SampleArray) -> dict[str, Any]:
    """Return the mask that the sides of values make; 0 is on the side ``zeros``, else inside."""
    look, wanted, samples = case.look, case.wanted, case.samples
    if look.is_two and 0 in (look.low, look.high) and wanted.inside == "auto":
        # the other value is inside, wherever it is
        case = replace(case, wanted=replace(wanted, inside="positive"))
        return _of_mask(case, changed(samples, partial(np.not_equal, 0), np.bool_), facts)
    if look.is_two:
        return _of_mask(case, changed(samples, partial(np.less, look.low), np.bool_), facts)
    if look.low > 0 or look.high < 0:
        raise GridError(
            f"every value is {'above' if look.low > 0 else 'below'} 0 (they go from {look.low:.6g} "
            f"to {look.high:.6g}), so their signs make no mask: {which_level(look_at(given))}"
        )
    if "step" in facts:
        spacing = case.spacing_or(facts["step"], "the step of the transform")
        case = replace(case, spacing=spacing)
    below, zeros = border_share(look, lambda x: x < 0), facts.get("zeros", 0)
    is_positive = below > 0.5 if wanted.inside == "auto" else wanted.inside == "positive"
    with_zeros = look.high == 0 or zeros > 0 or (look.low < 0 and zeros == 0 and is_positive)
    above = partial(np.less_equal if with_zeros else np.less, 0)
    return _of_mask(case, changed(samples, above, np.bool_), facts)


def _of_mask(case: Case, mask: SampleArray, facts: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the distances of the samples that are true to those that are not, on the lattice."""
    from .derived import extremes_of_masks, mask_planes

    positive = case.wanted.inside == "positive"
    if case.wanted.inside == "auto":  # the border is outside
        above = float(look_at(mask).faces.mean())
        positive, share = above < 0.5, max(above, 1 - above)
        if share < 1:
            case.notes.append(
                f"the {'larger' if positive else 'smaller'} value is taken as inside: {share:.0%} "
                "of the grid's border has the other one (if that is wrong, use --inside)"
            )
    if not positive:
        mask = changed(mask, np.logical_not, np.bool_)
    spacing = case.spacing_or(1, "since a mask shows none (give --spacing)")
    case.notes.append(
        "values taken as a mask (--field mask): they show the surface to half a voxel only"
    )
    h = min(steps_of(spacing))
    more = {"extremes": extremes_of_masks(h), "positive_inside": False}
    values = mask_planes(mask, h)
    return case.taken(spacing, mask_field(spacing), facts or {}, values=values, **more)


def mask_field(spacing: Triple) -> Field:
    """Return what a mask is taken as."""
    own = not is_cubic(spacing)
    return Field("mask", exact=NONE_EXACT, network="mask", sides_only=True, own_lattice=own)


# Densities, and fields with the surface of their spline


def _of_level(case: Case, given: SampleArray) -> dict[str, Any]:
    """Return values from which a level was taken, above it positive."""
    look, wanted = case.look, case.wanted
    if look.low >= 0 or look.high <= 0:
        before = look_at(given)
        raise GridError(
            f"no value is {'above' if look.high <= 0 else 'below'} the level {wanted.level:g} "
            f"(they go from {before.low:.6g} to {before.high:.6g}): {which_level(before)}"
        )
    if look.is_two or wanted.field == "mask":
        return _of_mask(case, changed(case.samples, partial(np.less, 0), np.bool_))
    if not look.is_finite:
        case = _with_known(case)
    spacing = case.spacing_or(1, "since densities show none (give --spacing)")
    return _of_spline(replace(case, spacing=spacing), {}, given, DENSITY)


def _of_spline(
    case: Case, facts: dict[str, Any], given: SampleArray, kind: str = "smooth"
) -> dict[str, Any]:
    """Return values in steps of their slope beside the surface, to be meshed by their spline."""
    if case.look.is_one_sided:
        raise GridError(f"no value is on the other side of 0: {which_level(look_at(given))}")
    spacing, slope = case.spacing or _estimated(case, facts), 1.0
    if case.wanted.scale is None:
        slope = _slope_at_surface(case.look, np.array(steps_of(spacing)))
    own = Field(
        kind,
        exact=NONE_EXACT,
        network=None,
        own_lattice=not is_cubic(spacing),
        has_jumps=bool(facts.get("cut")) and kind == "smooth",
    )
    extremes = case.look.low / slope, case.look.high / slope
    values: SampleArray = changed(case.samples, lambda planes: planes / slope)
    if "inside" in facts:
        from .derived import without_inner_faces

        deep = INNER * min(steps_of(spacing))
        values = without_inner_faces(values, facts["inside"], deep)
    return case.taken(spacing, own, facts, values=values, extremes=extremes)


def _slope_at_surface(look: Look, steps: Floats) -> float:
    """Return the typical slope beside the surface, in world units; of steps over 0 if unknown."""
    slope = typical_slope(look, steps, look.cut)
    if not np.isfinite(slope):
        slope = float(np.abs(look.pairs[0] - look.pairs[1]).max(initial=0)) / float(steps.min())
    return slope or 1.0


# Distances


def _of_distances(case: Case, facts: dict[str, Any]) -> dict[str, Any]:
    """Return distances, of which some may be cut off; what is missing is filled in if it helps."""
    spacing, look, cut = case.spacing, case.look, facts["cut"]
    if case.known is not None:  # unknown samples are taken as cut off
        cut = [look.low, look.high]
    assert spacing is not None
    positive = case.choose_side()
    low = look.low if look.low in cut and look.low < 0 else -np.inf
    high = look.high if look.high in cut and look.high > 0 else np.inf
    exact = (-high, -low) if positive else (low, high)
    steps = steps_of(spacing)
    at = min(-low, high) / max(steps)
    own, values = Field(exact=exact), case.samples
    if at < FILLED:
        case.notes.append(f"distances that are cut off {at:.3g} voxels from the surface")
    if at < TOO_NEAR:
        cubic = is_cubic(spacing)
        own = Field(exact=exact if cubic else NONE_EXACT, network=None, own_lattice=not cubic)
    elif at < FILLED:
        from .derived import filled_planes

        values = filled_planes(values, steps, (look.low, look.high))
    return case.taken(spacing, own, facts, values=values, positive_inside=positive)


def _estimated(case: Case, facts: dict[str, Any]) -> Triple:
    """Return the spacing that the values show, with a note; GridError if they show none."""
    look = case.look
    if facts.get("spacing") is None and "unit" not in facts:
        facts = recognise(case.samples, look).facts
    found = facts.get("spacing")
    if found is None:
        found = facts.get("unit") or _slope_at_surface(look, np.ones(3))
    found = np.ones(3) * found
    if not LEAST_SPACING <= found.min() <= found.max() <= MOST_SPACING:
        raise GridError(
            f"spacing not given: the values change by {found.max():.6g} from sample to sample; give"
            f" --spacing, in a unit in which it is between {LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
    if found.max() > UNEQUAL * found.min():
        for near in found.copy():  # axes that are equal but for the error of the estimate
            alike = np.abs(found / near - 1) <= SNAP
            found[alike] = found[alike].mean()
        spacing = check_spacing(found)
        shown = ", ".join(f"{h:.6g}" for h in spacing)
        case.notes.append(f"spacing not given: estimated as {shown} along x, y, z {APPROXIMATE}")
        return spacing
    measured, n = float(found.mean()), max(look.shape)
    usual = {"1": 1.0} | {f"{a}/{b}": a / b for a in (1, 2) for b in (n, n - 1)}
    name = min(usual, key=lambda key: abs(np.log(usual[key] / measured)))
    if abs(measured / usual[name] - 1) > SNAP:
        case.notes.append(f"spacing not given: estimated as {measured:.6g} {APPROXIMATE}")
        return (measured,) * 3
    case.notes.append(f"spacing not given: taken as {name}, the values show {measured:.6g}")
    return (usual[name],) * 3
