"""What a capture may take: sizes of its files, depth and counts of its JSON, pixels. All of it is checked before use.

Each limit is some ten times what the largest dome or scanner known to us writes; docs/capture_format.md lists them.
"""

from __future__ import annotations

MB = 1_000_000  # bytes

MAX_JSON_BYTES = 32 * MB  # regions name a few million vertices
MAX_JSON_DEPTH = 32  # brackets within brackets; the format needs 5
MAX_OBJECT_KEYS = 1_000  # of one JSON object
MAX_NAME_CHARACTERS = 64  # of ids, regions and landmarks
MAX_NAMED_UNKNOWN_KEYS = 20  # that a warning lists one by one

MAX_STORE_JSON_BYTES = 128 * MB  # of a record, manifest or table: a manifest names some 9,000 files in 1 MB
RESUMABLE_SECONDS = 24 * 3600.0  # for which the scratch of a killed ingest or fit is kept, so that it can continue

MAX_CAMERAS = 256
MAX_LIGHTS = 2_048
MAX_EXPOSURES = 64
MAX_FIBRES = 1_024
MAX_FIBRE_PIXELS = 2_000_000  # of the squares around all fibres together, in every bracket
MAX_SITES = 256
MAX_PLACEMENTS = 64  # of the probe at a site
MAX_PRESSURE_SAMPLES = 100_000
MAX_SEQUENCE_STEPS = 200_000  # lights x exposures, and repeated ones
MAX_REGIONS = 128  # each takes a byte of every surfel, and eight while they are made
MAX_FRAMES = 50_000  # of the face, of dark frames or of the white target: cameras x lights x exposures

MAX_FRAME_BYTES = 1_000 * MB
MAX_FRAME_SIDE_PX = 32_768
MAX_FRAME_PIXELS = 64_000_000  # two exposures of it take 2 GB while they are merged
# of deflate: a stored byte holds at most 1,032 of the picture, so that a small file cannot promise a large one
MAX_PNG_RATIO = 1_032

MAX_SCAN_BYTES = 1_000 * MB
MAX_PLY_TEXT_LINES = 5_000_000  # of a PLY file of text: 200 bytes each while it is read
MAX_SCAN_HEADER_BYTES = 65_536  # of a PLY file
MAX_SCAN_VERTICES = 10_000_000
MAX_SCAN_FACES = 20_000_000

MAX_RESPONSE_BYTES = 16 * MB  # a line for each of 65,536 values takes 4 MB

# of files that are decoded to find more faults, where a folder has some already
MAX_RECHECKED_BYTES = 1_000 * MB
