"""Which network refines which kind of field: masks have one of their own."""

from __future__ import annotations

from functools import lru_cache

from ..errors import FileError
from ..grid.field import MASK
from .decoder import Decoder
from .network import NO_NETWORKS, Network, load_network, shipped_models

MASK_MODEL = "mask"


def network_for(network: Decoder, kind: str) -> Decoder:
    """Return the network for a kind of field: that for masks in place of a shipped one.

    A network from another file, or any other function, is used as it is.

    Raises
    ------
    FileError
        If the network for masks is missing.
    """
    if kind != MASK or not isinstance(network, Network) or not network.shipped:
        return network
    return _for_masks(network.device, network.threads, network.symmetries)


@lru_cache(maxsize=2)
def _for_masks(device: str, threads: int, symmetries: int) -> Network:
    """Load the network for masks, once."""
    if MASK_MODEL not in shipped_models():
        raise FileError(f"the network {MASK_MODEL!r} is missing: {NO_NETWORKS}")
    return load_network(MASK_MODEL, device=device, threads=threads).averaged(symmetries)
