"""What `--cluster` takes. Light: the modules of options import it."""

from __future__ import annotations

from edge_depth_nerf.base.errors import InputError

LOCAL = "local"
"""Stands for a cluster of processes on this machine."""


def check_address(given: str | None) -> None:
    """Check the form of what was given to `--cluster`.

    Raises:
        InputError: neither local nor an address.
    """
    if given is not None and given != LOCAL and not given.startswith(("tcp://", "tls://")):
        raise InputError(
            f"--cluster {given}: expected {LOCAL}, or the address of a Dask scheduler, such as tcp://10.0.0.1:8786 or "
            "tls://10.0.0.1:8786."
        )
