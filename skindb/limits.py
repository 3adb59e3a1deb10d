"""Limits of a capture: sizes of files, depth and counts of JSON, pixels. All are
checked before the data are used.

Each limit is about ten times the largest value that known domes and scanners write;
docs/capture_format.md lists them.
"""

MB = 1_000_000  # bytes

MAX_JSON_BYTES = 32 * MB  # regions list a few million vertices
MAX_JSON_DEPTH = 32  # nested brackets; the format needs 5
MAX_OBJECT_KEYS = 1_000  # of one JSON object
MAX_NAME_CHARACTERS = 64  # of ids, regions and landmarks
# of the value of an attribute, a reference or a path inside a capture
MAX_TEXT_CHARACTERS = 256
MAX_NAMED_UNKNOWN_KEYS = 20  # listed individually in a warning

# of a record, manifest or table: a manifest lists about 9,000 files in 1 MB
MAX_STORE_JSON_BYTES = 128 * MB
# for which the first pass of a killed fit is kept, so that it can resume
RESUMABLE_SECONDS = 24 * 3600.0

MAX_CAMERAS = 256
MAX_LIGHTS = 2_048
MAX_EXPOSURES = 64
MAX_FIBRES = 1_024
MAX_FIBRE_PIXELS = 2_000_000  # total of the squares around all fibres, in every bracket
MAX_SITES = 256
MAX_PLACEMENTS = 64  # of the probe at a site
MAX_PRESSURE_SAMPLES = 100_000
MAX_SEQUENCE_STEPS = 200_000  # lights x exposures, and repetitions
MAX_BALL_PLACES = 64  # of the mirror ball in a calibration
MAX_KNOWN_POINTS = 10_000  # of a calibration, for the reprojection error
MAX_REGIONS = 128  # each needs one byte per surfel, and eight while it is computed
# cameras x lights x exposures of the face, of dark frames or of the white target
MAX_FRAMES = 50_000

MAX_FRAME_BYTES = 1_000 * MB
MAX_FRAME_SIDE_PX = 32_768
MAX_FRAME_PIXELS = 64_000_000  # merging two exposures of this size needs 2 GB
# compression of deflate: a stored byte expands to at most 1,032 bytes, so a small file
# cannot contain a large picture
MAX_PNG_RATIO = 1_032

MAX_SCAN_BYTES = 1_000 * MB
MAX_PLY_TEXT_LINES = 5_000_000  # of an ASCII PLY file: 200 bytes each while it is read
MAX_SCAN_HEADER_BYTES = 65_536  # of a PLY file
MAX_SCAN_VERTICES = 10_000_000
MAX_SCAN_FACES = 20_000_000

MAX_RESPONSE_BYTES = 16 * MB  # one line for each of 65,536 values needs 4 MB

# of files that are still decoded to find more faults, if a folder already has some
MAX_RECHECKED_BYTES = 1_000 * MB

# of commands; sizes beyond these are typing errors, and most would not fit into memory
MAX_COHORT = 10_000  # simulated subjects
MAX_VIRTUAL_VISITS = 100  # of a simulated subject
MAX_VISIT = 9999  # visits of a subject in a condition, and repeats of a visit
MAX_DEMO_TAKES = 8  # of the people of the demo
MAX_VIRTUAL_PIXELS = 8_000_000  # of a simulated frame, which needs 250 bytes each
# of a picture rendered at another scale, which needs 700 bytes each
MAX_PICTURE_PIXELS = 16_000_000
MAX_WORKERS = 256
MAX_WAIT_S = 7 * 24 * 3600.0
MAX_SEED = 10**9
MAX_PERMUTATIONS = 1_000_000
MAX_PHOTOGRAPHS = 64  # that an ingest keeps
# of a surface that is estimated from pictures; the equations of more take minutes
MAX_RELIEF_POINTS = 250_000
MAX_SPACING_MM = 1_000.0
