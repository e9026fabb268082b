"""Which network refines which kind of field: masks and noisy distances have their own."""

from __future__ import annotations

from functools import lru_cache

from ..errors import FileError
from ..grid.field import MASK, NOISY
from .contract import EXACT_DISTANCES
from .decoder import Decoder
from .network import NO_NETWORKS, Network, load_network, shipped_models

MASK_MODEL, NOISY_MODEL = "mask", "noisy"
KIND_MODELS = (MASK_MODEL, NOISY_MODEL)
"""The shipped networks that replace others for a kind of field."""


def network_for(network: Decoder, kind: str) -> Decoder:
    """Return the network for a kind of field: one for that kind in place of a shipped one.

    Masks have a network of their own. So have noisy distances, unless the network was itself
    trained on them. A network from another file, or any other function, is used as it is.

    Raises
    ------
    FileError
        If the network for the kind is missing.
    """
    if not isinstance(network, Network) or not network.shipped:
        return network
    chosen = network.device, network.threads, network.symmetries, network.precision
    if kind == MASK:
        return _load(MASK_MODEL, *chosen)
    if kind == NOISY and network.card.get("inputs") == EXACT_DISTANCES:
        return _load(NOISY_MODEL, *chosen)
    return network


@lru_cache(maxsize=4)
def _load(name: str, device: str, threads: int, symmetries: int, precision: str) -> Network:
    """Load a network for a kind, once."""
    if name not in shipped_models():
        raise FileError(f"the network {name!r} is missing: {NO_NETWORKS}")
    loaded = load_network(name, device=device, threads=threads, precision=precision)
    return loaded.averaged(symmetries)
