"""The table of limits: what a stranger's file may make this program take. Every reader takes its bounds from here.

A bound is checked before anything is allocated. Most are far above what sound files need, and low enough that a file of
a few megabytes ends in less than 1 GB and 5 s, in a model or in a sentence.
"""

# what a checkpoint describes

BUILDING_TIMES, BUILDING_BYTES = 8, 2**27
"""Memory that building a stored model may hold: so many times its weights, and so many bytes beside.

Members that are laid side by side are allocated twice, orthogonal first weights three times; bases of point sets and
tables of constants need no weights.
"""
CALLS_PER_WEIGHT, BUILDING_CALLS = 200, 10_000
"""Operations of torch for building a stored model: so many for each tensor of its weights, and so many beside.

A layer takes about ten; the second number takes less than a second.
"""
PREDICTING_TIMES, PREDICTING_BYTES, PREDICTING_ROW = 8, 2**27, 2**26
"""Memory that the first prediction of a stored model may hold: so many times its weights and inputs, so many bytes
beside, and so many for each sample, an occupancy grid of side 256 say.
"""
SMALL_RESULT = 2**17
"""Numbers, or bytes, of a result that nobody counts: its size is not computed before it is there."""
MOST_INPUT = 2**24
"""Numbers of one input, or of one target, that a checkpoint may describe: an image of 2,364 × 2,364 in colour.

A user's file of any size is scaled to an input of this size, so that it is the checkpoint that asks for the memory.
"""
MOST_SIDES = 8
"""Dimensions of one input."""
MOST_NAMES, LONGEST_NAME = 100_000, 1000
"""Names of numbers, classes or columns in a checkpoint, and letters of one."""
MOST_DRAWS = 2**17
"""Samples of a density that a stored setting may ask for; the usual number is 1000."""
MOST_DRAWN = 2**26
"""Numbers that all of them together may be, of one density; up to 1000 samples may be of any density."""

# compressed files

UNFOLDED_BYTES, UNFOLDED_TIMES = 2**27, 20
"""A compressed file may unfold to the larger of so many bytes, and so many times its size."""

# images

MOST_PIXELS, LONGEST_SIDE = 2**25 + 2**24, 2**16
"""Of an image as it is stored: 8,688 × 5,792, a camera's of 50 megapixels. Decoded, Pillow holds 4 bytes for each; with
alpha, or where its square is padded, it is there twice.
"""
MOST_PIXELS_OF = {"WEBP": 2**25, "JPEG2000": 2**25, "AVIF": 2**25}
"""Of formats whose decoders hold the image two or three times beside."""
MOST_PADDED = 2**26
"""Pixels of a square; where one that must be padded has more, it is scaled down before."""
AT_ONCE = 2**25
"""Pixels of images that several threads decode at the same time."""

# meshes and point clouds

MOST_ANNOUNCED = 2**31
"""Vertices or faces that a header may announce; more is damage."""
MOST_COLUMNS = 1000
"""Numbers that a vertex may have."""
MOST_NUMBERS = 2**24
"""Numbers that a compressed archive of points or of a body may unfold to, or as many as it has bytes; each takes 8
bytes when it is read.
"""

# volumes

MOST_OF_SPECTRA, MOST_VOXELS = 2**24, 2**22
"""Numbers in a volume of spectra, and its voxels, or as many as its file has bytes: 128 kB of zeros would unfold to 134
million.
"""

# scenes

MOST_PARTS, MOST_MATERIALS = 10_000, 10_000
"""Parts of a scene, each of one material; each takes a millisecond."""
MOST_TEXELS, FEW_TEXELS, TEXELS_PER_BYTE = 2**25, 2**24, 16
"""Of all textures of a scene together, two of 4096 × 4096; one where they have more than so many for each byte of their
files, as photographs have not. Drawn, each takes 44 bytes.
"""
SCENE_BYTES = 2**25
"""Bytes that a small glTF file may become: where several nodes show a mesh, it is there for each. A larger file may
become as much as a compressed one.
"""
MOST_JOINT_SETS = 4
"""Sets of four joints that a vertex follows."""
MOST_SAMPLES = 2**25
"""Of a picture, a camera file's say: 2560 × 1440 pixels of 9 samples. With colours and depth they take 1 GB."""

# other files

MOST_ARRAYS, DEEPEST_ARRAYS = 300_000, 32
"""Arrays in a MATLAB file, cells and fields of structs among them, and how many hold one another."""
MOST_TABLE_COLUMNS = 100_000
"""Columns of a CSV table."""
MOST_FRAMES = 1_000_000
"""Frames of a motion: two hours at 120 a second."""
MOST_DISPLACEMENTS = 2**24
"""Numbers of the joints' displacements of a body, joints × 3 × coefficients; published bodies have below 2**17."""
