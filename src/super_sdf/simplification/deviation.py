"""How far a simplified mesh lies from the unsimplified one."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Deviation:
    """Distances between a mesh and a simplified one, in world units or in voxels.

    Attributes
    ----------
    largest, mean : float
        From points of the mesh to the simplified one; the mean is over the area.
    largest_back, mean_back : float
        From points of the simplified mesh to the mesh.
    """

    largest: float
    mean: float
    largest_back: float
    mean_back: float

    def over(self, length: float) -> Deviation:
        """Return the distances divided by a length."""
        return Deviation(*(x / length for x in self.figures()))

    def figures(self) -> tuple[float, float, float, float]:
        """Return the four distances."""
        return self.largest, self.mean, self.largest_back, self.mean_back
