"""Generator of synthetic people, each scanned in several poses, in FAUST's layout."""

import hashlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from framework.bodies import poses
from framework.bodies.body import BodyModel
from framework.bodies.people import People, load_body
from framework.geometry.meshes import Mesh
from framework.geometry.ply_writer import write_ply
from framework.storage import cache
from framework.storage.generated import draw_all, ensure_generated
from plugins.data.registration import faust
from plugins.data.registration.faust import CHALLENGES, POSES, SUBJECTS, Pair
from plugins.data.registration.scanner import KINDS, Kinds, Scanner, scan

VERSION, SEED = 1, 0
"""Version and seed of the random draws; increase the version if the draws change."""
TEST_POSES = 3
"""Number of test scans of each person; FAUST has twenty."""
SCANNER, SHARES = Scanner(points=20_000, noise=0.002), Kinds(partial=0.3, outliers=0.0)
NO_FACES = np.empty((0, 3), np.int64)


def people_root(body: str | None) -> Path:
    """Return the folder of generated people in the cache; they are generated if they are not there.

    There are ten people in the ten poses of the training set and in three others, which are the test set. The folder
    also has the registrations of the test set, which FAUST does not publish.

    Args:
        body: file of a body model of the SMPL family (.npz, .pkl); None: the default body.

    Raises:
        DataError: the body is not available or cannot be read.
    """
    people = People(*load_body(body), spread=1.0)
    digest = hashlib.sha256(people.body.template.tobytes() + people.body.faces.tobytes()).hexdigest()[:16]
    mark = {"faust": VERSION, "seed": SEED, "scanner": str(SCANNER), "kinds": str(SHARES), "body": digest}
    root = cache.folder("faust") / hashlib.sha256(repr(sorted(mark.items())).encode()).hexdigest()[:16]
    return ensure_generated(root, mark, lambda folder: _write(folder, people))


def _write(folder: Path, people: People) -> None:
    model = BodyModel(people.body)
    random = np.random.default_rng(SEED)
    shape, _ = people.draw(SUBJECTS, random)
    movements = poses.draw(POSES + TEST_POSES, random)
    turned = poses.rotations(people.body, poses.skeleton(people.body), movements)
    pose = torch.from_numpy(turned.astype(people.body.template.dtype))

    def pose_person(person: int, stance: int) -> Float[np.ndarray, "vertex 3"]:
        with torch.no_grad():
            return model(shape[person : person + 1], pose[stance : stance + 1])[0].numpy()

    def write(number: int) -> None:
        person, stance = divmod(number, POSES + TEST_POSES)
        vertices = pose_person(person, stance)
        own = np.random.default_rng([SEED, number])
        kind = KINDS[own.choice(len(KINDS), p=SHARES.shares())]
        points = scan(Mesh("person", vertices.astype(float), people.body.faces), kind, SCANNER, own)
        if stance < POSES:
            place, registration = faust.training_scan, faust.training_registration
            number = person * POSES + stance
        else:
            place, registration = faust.test_scan, faust.test_registration
            number = person * TEST_POSES + stance - POSES
        write_ply(place(folder, number), points.astype(np.float32), NO_FACES)
        write_ply(registration(folder, number), vertices, people.body.faces)

    draw_all(SUBJECTS * (POSES + TEST_POSES), write, "people in FAUST's layout")
    for challenge in CHALLENGES:
        file = faust.pairs_file(folder, challenge)
        file.parent.mkdir(parents=True, exist_ok=True)
        lines = [str(pair) for pair in _pairs(challenge == "intra")]
        file.write_text("\n".join(lines) + "\n", encoding="ascii")


def _pairs(same: bool) -> list[Pair]:
    """Return pairs of test scans in two poses: of one person if `same`, otherwise of two successive people."""
    scan_pairs = []
    for person in range(SUBJECTS):
        other = person if same else (person + 1) % SUBJECTS
        for stance in range(TEST_POSES):
            scan_pairs.append(
                Pair(person * TEST_POSES + stance, other * TEST_POSES + (stance + 1) % TEST_POSES)
            )
    return scan_pairs
