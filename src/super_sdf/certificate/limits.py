"""Limits that a certificate must keep."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import OptionError
from .check import Certificate

NO_EVIDENCE = "no sample is exact, so no limit on residuals can be shown to be kept"


@dataclass(frozen=True)
class Limits:
    """What a certificate may have at most; None or False: not asked.

    Attributes
    ----------
    max_residual, max_mean : float, optional
        Largest and mean absolute residual, in voxels.
    max_share : float, optional
        Share of samples whose absolute residual is above a tenth of a voxel, from 0 to 1.
    no_faults : bool
        Whether faults of the mesh count.
    """

    max_residual: float | None = None
    max_mean: float | None = None
    max_share: float | None = None
    no_faults: bool = False

    def check(self) -> None:
        """Raise OptionError if a limit is out of range."""
        for name, unit in (("residual", "voxels"), ("mean", "voxels"), ("share", "1")):
            limit = getattr(self, f"max_{name}")
            if limit is not None and not 0 <= limit < float("inf"):
                raise OptionError(f"--max-{name} is {limit:g}: give 0 {unit} or more")
        if self.max_share is not None and self.max_share > 1:
            raise OptionError(f"--max-share is {self.max_share:g}: give a share from 0 to 1")

    def exceeded(self, certificate: Certificate) -> list[str]:
        """Return a sentence for each limit that a certificate exceeds."""
        faults = certificate.faults() if self.no_faults else []
        asked = {
            "largest": ("--max-residual", self.max_residual, "the largest residual is", " voxels"),
            "mean": ("--max-mean", self.max_mean, "the mean residual is", " voxels"),
            "share_above_tenth": ("--max-share", self.max_share, "above 0.1 voxel is", ""),
        }
        asked = {key: row for key, row in asked.items() if row[1] is not None}
        if asked and not len(certificate.touching.values):
            return [NO_EVIDENCE, *faults]
        figures = certificate.touching.summary() if asked else {}
        found = [
            f"{words} {figures[key]:.4g}{unit}, {option} is {limit:g}"
            for key, (option, limit, words, unit) in asked.items()
            if limit is not None and figures[key] > limit
        ]
        return found + [f"the mesh has {fault}" for fault in faults]
