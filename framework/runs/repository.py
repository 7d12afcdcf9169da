"""Reading of the commit and state of the git repository around a folder, without running programs that it names.

A repository may come from an untrusted source (SECURITY.md), and git runs the programs in the configuration of a
repository (`core.fsmonitor`, filters, hooks). The commit is therefore read from plain files. To find out whether files
differ from the commit, git is run in a temporary repository. The temporary repository shares the objects of the
original one, and has a copy of its index and a few harmless settings of its configuration.
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
"""Largest sizes in bytes: of a file with one reference or commit, of the file of packed references, of an index."""
LINKS = 5
"""Largest number of symbolic references that are followed in a chain, as in git."""
KEYS = frozenset(
    (
        *("core.autocrlf", "core.checkstat", "core.eol", "core.filemode", "core.ignorecase"),
        *("core.precomposeunicode", "core.sparsecheckout", "core.sparsecheckoutcone", "core.symlinks"),
        *("core.trustctime", "sparse.expectfilesoutsideofpatterns"),
    )
)
"""Settings that affect how git compares files and that name no program or file; `WORDS` are their allowed values."""
SPARSE = re.compile(rb"sdir[\0-\x10]")
"""Pattern of the entry that marks a sparse index, in which a folder stands for its files.

Such an index is not read, because git would expand it and change the times of objects in the repository.
"""
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
    """Return the `commit` of the repository around a folder, and whether tracked files differ from it (`dirty`).

    `commit` has 40 or 64 hexadecimal digits; `dirty` is "true" or "false". The result is empty if the folder is in no
    repository or in a repository without a commit. It is also empty if the repository belongs to another user and the
    current user's configuration does not list it under `safe.directory`. `dirty` is absent if git is missing, takes too
    long, or would have to run a filter program to compare the files. Submodules are not inspected.
    """
    try:
        repository = _repository(folder.resolve(strict=True))
        commit = repository and _commit(repository)
    except (OSError, RuntimeError, ValueError):  # for example a loop of links
        return {}
    if repository is None or commit is None:
        return {}
    user: list[tuple[str, str]] = []
    dirty = None
    with suppress(OSError, ValueError, subprocess.SubprocessError), TemporaryDirectory() as place:
        git = _Git(Path(place))
        user = git.settings("--list", user=True)
        if _is_owned(repository) or _is_listed_safe(repository.tree, user):
            dirty = _is_dirty(git, repository, commit, user)
    if not _is_owned(repository) and not _is_listed_safe(repository.tree, user):
        return {}
    return {"commit": commit} if dirty is None else {"commit": commit, "dirty": str(dirty).lower()}


def _repository(folder: Path) -> Repository | None:
    """Return the nearest repository that contains a folder, or None; like git, skip a `.git` without a repository."""
    ceilings = {
        os.path.realpath(ceiling)
        for ceiling in os.environ.get("GIT_CEILING_DIRECTORIES", "").split(":")
        if ceiling
    }
    across = os.environ.get("GIT_DISCOVERY_ACROSS_FILESYSTEM", "").lower() in TRUE[1:]
    device = folder.stat().st_dev
    for tree in (folder, *folder.parents):
        if tree != folder and (str(tree) in ceilings or (not across and tree.stat().st_dev != device)):
            return None
        path = tree / ".git"
        if path.is_dir():
            own, link = path, None
        elif (content := _text(path)) is not None:
            if not content.startswith("gitdir: "):
                return None
            own, link = tree / content.removeprefix("gitdir: "), path
        else:
            continue
        common = own / (_text(own / "commondir") or "")
        if all((common / name).is_dir() for name in ("objects", "refs")) and os.path.lexists(own / "HEAD"):
            return Repository(tree, own, common, link)
        if link is not None:
            return None
    return None


def _commit(repository: Repository) -> str | None:
    name = "HEAD"
    for _ in range(LINKS + 1):
        # a linked worktree has its own references under these names
        private = name == "HEAD" or name.startswith(("refs/bisect/", "refs/worktree/", "refs/rewritten/"))
        path = (repository.own if private else repository.common) / name
        if path.is_symlink():  # git once wrote symbolic references as links
            text = f"ref: {path.readlink()}"
        else:
            text = _text(path) or _packed_commit(repository.common, name)
        if text is None:
            return None
        if not text.startswith("ref:"):
            commit = text.split(maxsplit=1)[0].lower()
            return commit if re.fullmatch("[0-9a-f]{40}|[0-9a-f]{64}", commit) else None
        name = text.removeprefix("ref:").strip()
        if not re.fullmatch(r"refs(/(?!\.)[^/\x00- ~^:?*\[\\\x7f]+)+", name) or ".." in name:
            return None
    return None


def _packed_commit(common: Path, name: str) -> str | None:
    content = _content(common / "packed-refs", PACKED) or b""
    match = re.search(
        rb"^([0-9a-fA-F]{40,64}) " + re.escape(os.fsencode(name)) + rb"\r?$", content, re.MULTILINE
    )
    return match[1].decode() if match else None


def _is_owned(repository: Repository) -> bool:
    """Return whether the repository belongs to the current user or, if this user is root, to the caller of `sudo`."""
    user = os.geteuid()
    owners = {
        path.lstat().st_uid for path in (repository.tree, repository.own, repository.link) if path is not None
    }
    called_by = os.environ.get("SUDO_UID", "")
    allowed = {user, int(called_by)} if user == 0 and called_by.isdecimal() else {user}
    return owners <= allowed


def _is_listed_safe(tree: Path, settings: list[tuple[str, str]]) -> bool:
    """Return whether the user's `safe.directory` lists a folder; an empty value cancels the values before it."""
    safe = False
    for key, value in settings:
        if key == "safe.directory":
            safe = bool(value) and (safe or _matches(value, tree))
    return safe


def _matches(value: str, tree: Path) -> bool:
    if value == "*":
        return True
    try:
        path = Path(value).expanduser()
    except RuntimeError:  # no such user
        return False
    if not path.is_absolute():
        return False
    return path.parent.resolve() in tree.parents if path.name == "*" else path.resolve() == tree


def _is_dirty(git: "_Git", repository: Repository, commit: str, user: list[tuple[str, str]]) -> bool | None:
    repository_settings = git.settings_of(repository.common / "config")
    if ("extensions.worktreeconfig", True) in (
        (key, value.lower() in TRUE) for key, value in repository_settings
    ):
        repository_settings += git.settings_of(repository.own / "config.worktree")
    work_tree = dict(repository_settings).get("core.worktree")
    if repository.own == repository.common and (
        (work_tree is not None and os.path.realpath(repository.own / work_tree) != str(repository.tree))
        or dict(repository_settings).get("core.bare", "false").lower() in TRUE
    ):
        return None
    settings = {
        key: value for key, value in (*user, *repository_settings) if key in KEYS and value.lower() in WORDS
    }
    git.write(settings, commit)
    for name in ("index", *_shared_indices(repository.own)):
        if _copy(repository.own / name, git.folder / name) and SPARSE.search(
            (git.folder / name).read_bytes()
        ):
            return None
    _copy(repository.common / "info" / "attributes", git.folder / "info" / "attributes")
    changes = git.ask(
        "status",
        *("--porcelain=v1", "-z", "--no-renames", "--untracked-files=no", "--ignore-submodules=all"),
        tree=repository.tree,
        objects=repository.common / "objects",
    )
    lines = [line for line in changes.split(b"\0") if line]
    # for a file with a filter program, git would compare the output of that program, which must not be run
    doubtful = [line[3:] for line in lines if line[:2] == b" M"]
    if len(doubtful) < len(lines) or not lines:
        return bool(lines)
    filters = git.ask(
        *("check-attr", "-z", "--stdin", "filter"),
        stdin=b"\0".join(doubtful) + b"\0",
        tree=repository.tree,
        objects=repository.common / "objects",
    )
    plain = [value in (b"unspecified", b"unset") for value in filters.split(b"\0")[2::3]]
    return True if any(plain) or len(plain) < len(doubtful) else None


def _shared_indices(own: Path) -> Iterator[str]:
    """Yield the names of the newest shared index files (at most 8), to which a split index may refer."""
    shared = [
        file for file in own.iterdir() if re.fullmatch(r"sharedindex\.([0-9a-f]{40}|[0-9a-f]{64})", file.name)
    ]
    yield from (file.name for file in sorted(shared, key=lambda file: -file.lstat().st_mtime_ns)[:8])


class _Git:
    """The program git, run in a temporary repository. It is stopped if it exceeds the time limit.

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
        """Write `HEAD` (with `commit`) and the configuration (only `settings`) of the temporary repository."""
        sha256 = len(commit) == 64
        lines = ["[core]\nbare = false", f"repositoryformatversion = {int(sha256)}"]
        lines += ["[extensions]\nobjectformat = sha256"] * sha256
        for key, value in settings.items():
            section, _, name = key.partition(".")
            lines.append(f"[{section}]\n{name} = {value or 'true'}")
        (self.folder / "config").write_text("\n".join([*lines, ""]))
        (self.folder / "HEAD").write_text(f"{commit or 'ref: refs/heads/none'}\n")

    def settings_of(self, file: Path) -> list[tuple[str, str]]:
        """Return the settings in an untrusted configuration file without applying them or reading included files.

        Raises:
            OSError: The file is not a regular file, or it is too large.
        """
        copy = self.folder / "theirs"
        copy.unlink(missing_ok=True)
        return self.settings("--file", str(copy), "--no-includes", "--list") if _copy(file, copy) else []

    def settings(self, *arguments: str, user: bool = False) -> list[tuple[str, str]]:
        """Return the keys (in lower case) and values that `git config` prints.

        If `user` is True, git also reads the settings of the user and of the system.
        """
        output = self.ask("config", "--null", *arguments, user=user).decode(errors="surrogateescape")
        pairs = (item.partition("\n") for item in output.split("\0") if item)
        return [(key.lower(), value) for key, _, value in pairs]

    def ask(
        self,
        *arguments: str,
        stdin: bytes = b"",
        user: bool = False,
        tree: Path | None = None,
        objects: Path | None = None,
    ) -> bytes:
        """Run git and return its output.

        Args:
            arguments: Command and options of git.
            stdin: Standard input of git.
            user: Whether git reads the settings of the user and the system.
            tree: Folder with the files to compare, if any.
            objects: Folder with the objects to read, if any.

        Raises:
            OSError, subprocess.SubprocessError: git fails, or the time limit is reached.
        """
        # the variable GIT_CONFIG is left out, because it names a file for `git config` only
        inherited = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith("GIT_") or (user and name.startswith("GIT_CONFIG_"))
        }
        own = {"GIT_CONFIG_NOSYSTEM": "1", "GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_SYSTEM": os.devnull}
        own |= {"HOME": str(self.folder), "XDG_CONFIG_HOME": str(self.folder)}  # for git before 2.32
        # git would write new objects into the temporary repository
        places = {"GIT_WORK_TREE": tree, "GIT_ALTERNATE_OBJECT_DIRECTORIES": objects and _quote_path(objects)}
        environment = {
            **inherited,
            **({} if user else own),
            **{name: str(place) for name, place in places.items() if place is not None},
            "GIT_ALLOC_LIMIT": "256m",
            "GIT_DIR": str(self.folder),
            "GIT_NO_LAZY_FETCH": "1",
            "GIT_OPTIONAL_LOCKS": "0",
            "PATH": self.path,
        }
        process = subprocess.run(
            [self.program, *arguments],
            cwd=self.folder,
            env=environment,
            input=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=max(self.end - time.monotonic(), 0.01),
            check=True,
        )
        return process.stdout


def _quote_path(path: Path) -> str:
    """Return a path in quotes, so that git, which reads a list separated by colons, keeps a colon in the path."""
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

    git uses the time of the index to detect files that changed while the index was written.

    Raises:
        OSError: The source is not a regular file, or it is too large.
    """
    if not os.path.lexists(source):
        return False
    written = source.lstat().st_mtime_ns
    content = _content(source, INDEX)
    if content is None:
        raise OSError(f"{source} is not a regular file of at most {INDEX} bytes")
    to.write_bytes(content)
    os.utime(to, ns=(written, written))
    return True
