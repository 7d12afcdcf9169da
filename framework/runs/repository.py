"""Commit and state of the git repository around a folder; no program that the repository names is ever run.

A repository may come from an untrusted source (DESIGN, law 15), and git runs the programs that its configuration names
(`core.fsmonitor`, filters, hooks). The commit is therefore read from plain files. To find out whether files differ, git
is run in a temporary repository. That repository shares the objects of the original, and holds a copy of its index and
a few harmless settings of its configuration.
"""

import os
import re
import shutil
import stat
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

SECONDS = 3.0
"""Time limit, in seconds, for all git commands about one repository."""
SMALL, PACKED, INDEX = 2**12, 2**26, 2**28
"""Largest size in bytes of a file with one name or commit, of a list of packed references, and of an index."""
LINKS = 5
"""Largest number of symbolic references that are followed in a chain, as in git."""
KEYS = frozenset(
    (
        *("core.autocrlf", "core.checkstat", "core.eol", "core.filemode", "core.ignorecase"),
        *("core.precomposeunicode", "core.sparsecheckout", "core.sparsecheckoutcone", "core.symlinks"),
        *("core.trustctime", "sparse.expectfilesoutsideofpatterns"),
    )
)
"""Settings by which git compares files; their values must be in `WORDS`, and none names a program or a file."""
SPARSE = re.compile(rb"sdir[\0-\x10]")
"""Mark of a sparse index, which holds folders in place of files; git changes the times of objects to expand them."""
TRUE = ("", "1", "on", "true", "yes")
WORDS = frozenset((*TRUE, "0", "crlf", "default", "false", "input", "lf", "minimal", "native", "no", "off"))


class Repository(NamedTuple):
    """Paths of a git repository.

    Attributes:
        tree: Folder with the files of the repository.
        own: Folder with `HEAD` and the index.
        common: Folder with objects, configuration and most references; it differs from `own` in a linked worktree.
        link: The file `.git` that names `own`; None if `.git` is a folder.
    """

    tree: Path
    own: Path
    common: Path
    link: Path | None


def git_commit(folder: Path) -> dict[str, str]:
    """Return the `commit` (40 or 64 hex digits) around a folder, and `dirty` ("true" if tracked files differ from it).

    The result is empty if the folder is in no repository, in a repository without a commit, or in a repository of
    another user that the user's own `safe.directory` does not list. `dirty` is absent if git is missing, takes too
    long, or would have to run a filter program to compare the files. Submodules are not inspected.
    """
    try:
        found = _repository(folder.resolve(strict=True))
        commit = found and _commit(found)
    except (OSError, RuntimeError, ValueError):  # for example a loop of links
        return {}
    if found is None or commit is None:
        return {}
    user: list[tuple[str, str]] = []
    dirty = None
    with suppress(OSError, ValueError, subprocess.SubprocessError), TemporaryDirectory() as place:
        git = _Git(Path(place))
        user = git.settings("--list", user=True)
        if _owned(found) or _listed(found.tree, user):
            dirty = _dirty(git, found, commit, user)
    if not _owned(found) and not _listed(found.tree, user):
        return {}
    return {"commit": commit} if dirty is None else {"commit": commit, "dirty": str(dirty).lower()}


def _repository(folder: Path) -> Repository | None:
    """Return the nearest enclosing repository, or None; as in git, a folder `.git` that is no repository is skipped."""
    ceilings = {
        os.path.realpath(one) for one in os.environ.get("GIT_CEILING_DIRECTORIES", "").split(":") if one
    }
    across = os.environ.get("GIT_DISCOVERY_ACROSS_FILESYSTEM", "").lower() in TRUE[1:]
    device = folder.stat().st_dev
    for tree in (folder, *folder.parents):
        if tree != folder and (str(tree) in ceilings or (not across and tree.stat().st_dev != device)):
            return None
        path = tree / ".git"
        if path.is_dir():
            own, link = path, None
        elif (named := _text(path)) is not None:
            if not named.startswith("gitdir: "):
                return None
            own, link = tree / named.removeprefix("gitdir: "), path
        else:
            continue
        common = own / (_text(own / "commondir") or "")
        if all((common / name).is_dir() for name in ("objects", "refs")) and os.path.lexists(own / "HEAD"):
            return Repository(tree, own, common, link)
        if link is not None:
            return None
    return None


def _commit(found: Repository) -> str | None:
    name = "HEAD"
    for _ in range(LINKS + 1):
        # a linked worktree has references of its own under these names
        private = name == "HEAD" or name.startswith(("refs/bisect/", "refs/worktree/", "refs/rewritten/"))
        path = (found.own if private else found.common) / name
        if path.is_symlink():  # git once wrote symbolic references as links
            text = f"ref: {path.readlink()}"
        else:
            text = _text(path) or _packed(found.common, name)
        if text is None:
            return None
        if not text.startswith("ref:"):
            commit = text.split(maxsplit=1)[0].lower()
            return commit if re.fullmatch("[0-9a-f]{40}|[0-9a-f]{64}", commit) else None
        name = text.removeprefix("ref:").strip()
        if not re.fullmatch(r"refs(/(?!\.)[^/\x00- ~^:?*\[\\\x7f]+)+", name) or ".." in name:
            return None
    return None


def _packed(common: Path, name: str) -> str | None:
    content = _content(common / "packed-refs", PACKED) or b""
    found = re.search(
        rb"^([0-9a-fA-F]{40,64}) " + re.escape(os.fsencode(name)) + rb"\r?$", content, re.MULTILINE
    )
    return found[1].decode() if found else None


def _owned(found: Repository) -> bool:
    """Return whether the repository belongs to this user or, as in git, to the user who called `sudo`."""
    user = os.geteuid()
    owners = {path.lstat().st_uid for path in (found.tree, found.own, found.link) if path is not None}
    called_by = os.environ.get("SUDO_UID", "")
    allowed = {user, int(called_by)} if user == 0 and called_by.isdecimal() else {user}
    return owners <= allowed


def _listed(tree: Path, settings: list[tuple[str, str]]) -> bool:
    """Return whether the user's `safe.directory` lists a folder; an empty value clears the values before it."""
    safe = False
    for key, value in settings:
        if key == "safe.directory":
            safe = bool(value) and (safe or _names(value, tree))
    return safe


def _names(value: str, tree: Path) -> bool:
    if value == "*":
        return True
    try:
        path = Path(value).expanduser()
    except RuntimeError:  # no such user
        return False
    if not path.is_absolute():
        return False
    return path.parent.resolve() in tree.parents if path.name == "*" else path.resolve() == tree


def _dirty(git: "_Git", found: Repository, commit: str, user: list[tuple[str, str]]) -> bool | None:
    theirs = git.settings_of(found.common / "config")
    if ("extensions.worktreeconfig", True) in ((key, value.lower() in TRUE) for key, value in theirs):
        theirs += git.settings_of(found.own / "config.worktree")
    elsewhere = dict(theirs).get("core.worktree")
    if found.own == found.common and (
        (elsewhere is not None and os.path.realpath(found.own / elsewhere) != str(found.tree))
        or dict(theirs).get("core.bare", "false").lower() in TRUE
    ):
        return None
    kept = {key: value for key, value in (*user, *theirs) if key in KEYS and value.lower() in WORDS}
    git.write(kept, commit)
    for name in ("index", *_shared_indices(found.own)):
        if _copy(found.own / name, git.folder / name) and SPARSE.search((git.folder / name).read_bytes()):
            return None
    _copy(found.common / "info" / "attributes", git.folder / "info" / "attributes")
    changes = git.ask(
        "status",
        *("--porcelain=v1", "-z", "--no-renames", "--untracked-files=no", "--ignore-submodules=all"),
        tree=found.tree,
        objects=found.common / "objects",
    )
    lines = [line for line in changes.split(b"\0") if line]
    # for a file with a filter program, git would compare the output of that program, which is not run here
    doubtful = [line[3:] for line in lines if line[:2] == b" M"]
    if len(doubtful) < len(lines) or not lines:
        return bool(lines)
    filters = git.ask(
        *("check-attr", "-z", "--stdin", "filter"),
        given=b"\0".join(doubtful) + b"\0",
        tree=found.tree,
        objects=found.common / "objects",
    )
    plain = [value in (b"unspecified", b"unset") for value in filters.split(b"\0")[2::3]]
    return True if any(plain) or len(plain) < len(doubtful) else None


def _shared_indices(own: Path) -> Iterator[str]:
    """Yield the names of the newest files (at most 8) that a split index may share."""
    shared = [
        one for one in own.iterdir() if re.fullmatch(r"sharedindex\.([0-9a-f]{40}|[0-9a-f]{64})", one.name)
    ]
    yield from (one.name for one in sorted(shared, key=lambda one: -one.lstat().st_mtime_ns)[:8])


class _Git:
    """The program git, run in a temporary repository until the time limit.

    Raises:
        OSError: git is not installed.
    """

    def __init__(self, folder: Path) -> None:
        # a relative entry of PATH could lead into the untrusted folder
        self.path = os.pathsep.join(filter(os.path.isabs, os.get_exec_path()))
        program = shutil.which("git", path=self.path)
        if program is None:
            raise FileNotFoundError("git is not installed")
        self.program, self.folder = program, folder
        self.end = time.monotonic() + SECONDS
        for name in ("objects", "refs", "info"):
            (folder / name).mkdir()
        self.write({}, "")

    def write(self, settings: Mapping[str, str], commit: str) -> None:
        """Write the temporary repository's `HEAD` and configuration, with these settings only."""
        sha256 = len(commit) == 64
        lines = ["[core]\nbare = false", f"repositoryformatversion = {int(sha256)}"]
        lines += ["[extensions]\nobjectformat = sha256"] * sha256
        for key, value in settings.items():
            section, _, name = key.partition(".")
            lines.append(f"[{section}]\n{name} = {value or 'true'}")
        (self.folder / "config").write_text("\n".join([*lines, ""]))
        (self.folder / "HEAD").write_text(f"{commit or 'ref: refs/heads/none'}\n")

    def settings_of(self, file: Path) -> list[tuple[str, str]]:
        """Return the settings of an untrusted configuration file without applying them or reading included files.

        Raises:
            OSError: It is no regular file, or it is too large.
        """
        copy = self.folder / "theirs"
        copy.unlink(missing_ok=True)
        return self.settings("--file", str(copy), "--no-includes", "--list") if _copy(file, copy) else []

    def settings(self, *arguments: str, user: bool = False) -> list[tuple[str, str]]:
        """Return keys (in lower case) and values in their order; with `user`, the settings of user and system."""
        found = self.ask("config", "--null", *arguments, user=user).decode(errors="surrogateescape")
        pairs = (one.partition("\n") for one in found.split("\0") if one)
        return [(key.lower(), value) for key, _, value in pairs]

    def ask(
        self,
        *arguments: str,
        given: bytes = b"",
        user: bool = False,
        tree: Path | None = None,
        objects: Path | None = None,
    ) -> bytes:
        """Run git and return its output.

        Args:
            arguments: Command and options of git.
            given: Standard input.
            user: Whether git reads the settings of the user and the system.
            tree: Folder with the files to compare, if any.
            objects: Folder with the objects to read, if any.

        Raises:
            OSError, subprocess.SubprocessError: git fails, or the time is over.
        """
        # the variable GIT_CONFIG names a file for `git config` only, so it is not kept
        kept = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith("GIT_") or (user and name.startswith("GIT_CONFIG_"))
        }
        own = {"GIT_CONFIG_NOSYSTEM": "1", "GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_SYSTEM": os.devnull}
        own |= {"HOME": str(self.folder), "XDG_CONFIG_HOME": str(self.folder)}  # for git before 2.32
        # if git ever writes an object, it goes into the temporary repository
        places = {"GIT_WORK_TREE": tree, "GIT_ALTERNATE_OBJECT_DIRECTORIES": objects and _escaped(objects)}
        environment = {
            **kept,
            **({} if user else own),
            **{name: str(place) for name, place in places.items() if place is not None},
            "GIT_ALLOC_LIMIT": "256m",
            "GIT_DIR": str(self.folder),
            "GIT_NO_LAZY_FETCH": "1",
            "GIT_OPTIONAL_LOCKS": "0",
            "PATH": self.path,
        }
        done = subprocess.run(
            [self.program, *arguments],
            cwd=self.folder,
            env=environment,
            input=given,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=max(self.end - time.monotonic(), 0.01),
            check=True,
        )
        return done.stdout


def _escaped(path: Path) -> str:
    """Return a path in quotes, as the only one of a list of paths, in which a colon would otherwise end it."""
    escaped = str(path).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _text(path: Path) -> str | None:
    """Return the text of a short regular file without surrounding blanks; None if there is no such file."""
    content = _content(path, SMALL)
    return None if content is None else os.fsdecode(content).strip()


def _content(path: Path, most: int) -> bytes | None:
    """Return the content of a regular file; None if it is missing, a link, or larger than `most` bytes."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    with os.fdopen(descriptor, "rb") as stream:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_size > most:
            return None
        content = stream.read(most + 1)
        return content if len(content) <= most else None


def _copy(source: Path, to: Path) -> bool:
    """Copy a file with its modification time, and return whether it exists.

    From the time of the index, git detects files that changed while the index was written.

    Raises:
        OSError: The source is no regular file, or is too large.
    """
    if not os.path.lexists(source):
        return False
    written = source.lstat().st_mtime_ns
    content = _content(source, INDEX)
    if content is None:
        raise OSError(f"{source} is no regular file of at most {INDEX} bytes")
    to.write_bytes(content)
    os.utime(to, ns=(written, written))
    return True
