"""Sizes of the blocks that data are worked on and stored in."""

SHARD = 4096  # surfels of a block: one task writes one file
