"""Operations of a place on one key, which must not leave the database."""

from __future__ import annotations

import pytest

from skindb.errors import InputError


def require_refused(place, key):
    """Require that each operation refuses a key that leaves the database."""
    for operation in (
        place.read,
        place.read_small,
        place.children,
        place.sizes,
        place.identities,
        place.digests,
        place.remove,
        lambda name: place.create(name, b"x"),
        lambda name: place.replace(name, b"x"),
        place.make_durable,
        place.writable,
        place.url,
    ):
        with pytest.raises(
            InputError, match="every path must stay inside the database"
        ):
            operation(key)
