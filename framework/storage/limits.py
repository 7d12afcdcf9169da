"""Limits on the memory and time that an untrusted file can make this program use, for all readers of such files.

A limit is checked before anything is allocated. Most limits are far above what valid files need. They are low enough
that reading a file of a few megabytes takes less than 1 GB and 5 s, whether it succeeds or ends with an error message.
"""

# models that a checkpoint describes

BUILDING_TIMES, BUILDING_BYTES = 8, 2**27
"""Limit on the memory for building a stored model: BUILDING_TIMES × the bytes of its weights, plus BUILDING_BYTES.

The weights of ensemble members that are computed together are allocated twice, and orthogonal initial weights three
times. Basis point sets and tables of constants take memory although they are not weights.
"""
CALLS_PER_WEIGHT, BUILDING_CALLS = 200, 10_000
"""Limit on torch's operations for building a stored model: CALLS_PER_WEIGHT for each tensor, plus BUILDING_CALLS.

A layer takes about ten operations; BUILDING_CALLS operations take less than a second.
"""
PREDICTING_TIMES, PREDICTING_BYTES, PREDICTING_ROW = 8, 2**27, 2**26
"""Limit on the memory for the first prediction of a stored model.

The limit is PREDICTING_TIMES × the bytes of weights and inputs, plus PREDICTING_BYTES, plus PREDICTING_ROW bytes for
each sample (for an occupancy grid of side 256, for example).
"""
SMALL_RESULT = 2**17
"""Largest result of an operation of torch, in bytes, that is not counted towards the memory limits."""
MOST_INPUT = 2**24
"""Largest number of elements of one input or target in a checkpoint: a colour image of 2,364 × 2,364 pixels.

An image file of any size is scaled to the input size that the checkpoint states, so the checkpoint determines how much
memory an input takes.
"""
MOST_SIDES = 8
"""Largest number of dimensions of one input."""
MOST_NAMES, LONGEST_NAME = 100_000, 1000
"""Largest number of names of targets, classes or columns in a checkpoint, and of characters in one name."""
MOST_DRAWS = 2**17
"""Largest number of samples of a density that a stored setting may request; the usual number is 1000."""
MOST_DRAWN = 2**26
"""Largest number of elements in all samples of one density together; 1000 samples are always allowed."""

# compressed files

UNFOLDED_BYTES, UNFOLDED_TIMES = 2**27, 20
"""A compressed file may decompress to UNFOLDED_BYTES or UNFOLDED_TIMES × its own size, whichever is larger.

The same holds for a sparse file, most of whose bytes are not stored and read as zeros.
"""

# images

MOST_PIXELS, LONGEST_SIDE = 2**25 + 2**24, 2**16
"""Largest number of pixels of an image file (8,688 × 5,792, a 50-megapixel camera), and of pixels along a side.

Pillow uses 4 bytes for each decoded pixel. An image with an alpha channel, or one that is padded to a square, takes
this memory twice.
"""
MOST_PIXELS_OF = {"WEBP": 2**25, "JPEG2000": 2**25, "AVIF": 2**25}
"""Largest number of pixels in formats whose decoders create two or three further copies of the image."""
MOST_ICON = 2**22
"""Largest number of pixels of an image in an icon (ICO); programs write at most 1024 × 1024."""
MOST_SCANS = 100
"""Largest number of scans of a JPEG image, as in libtiff (LIBTIFF_JPEG_MAX_ALLOWED_SCAN_NUMBER); programs write ten.

A scan of a hundred bytes can pass over every pixel of the image, which takes milliseconds.
"""
FEW_IMAGES, BYTES_PER_IMAGE = 100_000, 16
"""Number of images that a small idx file may hold, and least number of bytes of the file for each further image.

An image takes some hundred bytes in memory, however few pixels it has. An image of MNIST takes about 160 bytes of its
packed file.
"""
MOST_PADDED = 2**26
"""Largest number of pixels of an image padded to a square; a larger one is scaled down before the padding."""
AT_ONCE = 2**25
"""Largest number of pixels of all images that several threads decode at the same time."""

# meshes and point clouds

MOST_ANNOUNCED = 2**31
"""Largest number of vertices or faces in the header of a file; a larger number means that the file is damaged."""
MOST_COLUMNS = 1000
"""Largest number of values (coordinates, colours and others) that a file may store for each vertex."""
MOST_NUMBERS = 2**24
"""Number of values to which a compressed point cloud, body model or table may decompress, however small it is.

A file with more bytes than this may contain as many values as it has bytes. Each value takes 8 bytes in memory.
"""

# volumes

MOST_OF_SPECTRA, MOST_VOXELS = 2**24, 2**22
"""Number of values and number of voxels that a volume of spectra may contain, however small its file is.

A larger file may contain as many values as it has bytes, and a quarter as many voxels. Without the limit, 128 kB of
compressed zeros would decompress to 134 million values.
"""

# scenes

MOST_PARTS, MOST_MATERIALS = 10_000, 10_000
"""Largest number of parts of a scene, and of its materials; a part has one material and takes a millisecond."""
MOST_TEXELS, FEW_TEXELS, TEXELS_PER_BYTE = 2**25, 2**24, 16
"""Largest number of texels in all textures of a scene, enough for two textures of 4096 × 4096.

If the textures have more than TEXELS_PER_BYTE texels for each byte of their files, which photographs never have, the
limit is FEW_TEXELS (one such texture). A texel takes 44 bytes while the scene is drawn.
"""
SCENE_BYTES = 2**25
"""Number of bytes to which a small glTF file may expand, because a mesh is copied for each node that shows it.

A larger file may expand by the same factor as a compressed file (`UNFOLDED_TIMES`).
"""
MOST_JOINT_SETS = 4
"""Largest number of sets of joints per vertex in a glTF file; a set names four joints that move the vertex."""
MOST_SAMPLES = 2**25
"""Largest number of samples of a drawn image.

An image of 2560 × 1440 pixels with 9 samples each just fits; colour and depth of its samples take 1 GB.
"""

# other files

MOST_ARRAYS, DEEPEST_ARRAYS = 300_000, 32
"""Largest number of arrays in a MATLAB file, including cells and struct fields, and largest depth of nesting."""
MOST_TABLE_COLUMNS = 100_000
"""Largest number of columns of a CSV table."""
MOST_FRAMES = 1_000_000
"""Largest number of frames of a motion: two hours at 120 frames per second."""
MOST_DISPLACEMENTS = 2**24
"""Largest size of a body's joint displacements (joints × 3 × coefficients); published bodies have less than 2**17."""
