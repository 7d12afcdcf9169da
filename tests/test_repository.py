"""Commit and state of a repository, compared with git, without running any program that the repository names."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from framework.runs import repository
from framework.runs.repository import git_commit
from tests.conftest import TINY, Framework

STATES = {
    "unborn": "git init -q -b main new; cd new",
    "clean": "",
    "untracked": "echo 2 > new.txt",
    "modified": "echo 2 > a.txt",
    "below": "echo 2 > a.txt; cd inside",
    "touched": "touch -d 2001-01-01 a.txt",
    "as old as the index": """
        git config core.trustctime false; git config core.checkStat minimal
        echo c > a.txt; touch -d 2020-01-01 a.txt; git commit -q -a -m old
        echo 2 > a.txt; touch -d 2020-01-01 a.txt; touch -d 2019-01-01 .git/index""",
    "staged": "echo 2 > a.txt; git add a.txt",
    "staged, then taken back": "echo 2 > a.txt; git add a.txt; git show HEAD:a.txt > a.txt",
    "deleted": "rm a.txt",
    "staged deletion": "git rm -q --cached a.txt",
    "intended": "echo 2 > new.txt; git add -N new.txt",
    "executable": "chmod +x a.txt",
    "executable, not looked at": "git config core.fileMode false; chmod +x a.txt",
    "a link in its place": "rm a.txt; ln -s b.txt a.txt",
    "moved": "git mv a.txt c.txt",
    "lines of Windows": "git config core.autocrlf true; printf 'a\\r\\n' > a.txt",
    "lines of Windows by attribute": """
        echo '* text eol=crlf' > .gitattributes; git add .; git commit -q -m crlf; printf 'a\\r\\n' > a.txt""",
    "lines of Windows by own attribute": "echo '* text' > .git/info/attributes; printf 'a\\r\\n' > a.txt",
    "lines of Windows in the file alone": "printf 'a\\r\\n' > a.txt",
    "detached": "git checkout -q --detach",
    "branch with a slash": "git checkout -q -b some/where",
    "packed": "git pack-refs --all; git gc -q",
    "packed, then gone on": "git pack-refs --all; echo 2 > a.txt; git commit -q -a -m second",
    "linked HEAD": "ln -sf refs/heads/main .git/HEAD",
    "a name of a name": "git symbolic-ref refs/heads/other refs/heads/main; git symbolic-ref HEAD refs/heads/other",
    "names in a circle": "git symbolic-ref refs/heads/b HEAD; git symbolic-ref HEAD refs/heads/b",
    "no commit by that name": "git symbolic-ref HEAD refs/heads/none",
    "no HEAD": "rm .git/HEAD",
    "nonsense in HEAD": "echo nonsense > .git/HEAD",
    "no index": "rm .git/index",
    "damaged index": "head -c 50 .git/index > new; mv new .git/index",
    "damaged configuration": "echo '[' >> .git/config",
    "empty .git": "mkdir -p x/.git; cd x",
    "worktree": "git worktree add -q ../other; cd ../other; echo 2 > a.txt; git checkout -q --detach",
    "worktree of its own settings": """
        git config extensions.worktreeConfig true; git worktree add -q ../other; cd ../other
        git config --worktree core.autocrlf true; printf 'a\\r\\n' > a.txt""",
    "submodule": """
        git -c protocol.file.allow=always submodule --quiet add ./. part
        git commit -q -m part; cd part; echo 2 > a.txt""",
    "around a submodule": """
        git -c protocol.file.allow=always submodule --quiet add ./. part; git commit -q -m part; echo 2 > part/a.txt""",
    "folder elsewhere": "mv .git ../store; echo 'gitdir: ../store' > .git; echo 2 > a.txt",
    "sha256": """
        git init -q -b main --object-format=sha256 ../other; cd ../other; echo 1 > a.txt; git add .
        git commit -q -m first; touch -d 2001-01-01 a.txt""",
    "split index": "git update-index --split-index; echo 2 > c.txt; git add c.txt; git commit -q -m c",
    "split index, modified": "git update-index --split-index; echo 2 > c.txt; git add c.txt; echo 3 > c.txt",
    "sparse": "git sparse-checkout set --no-cone /inside/",
    "sparse, by a present file": "git sparse-checkout set --no-cone /inside/; echo 2 > a.txt",
    "sparse index": "git sparse-checkout set --cone --sparse-index inside; echo 2 > a.txt",
    "skipped": "git update-index --skip-worktree a.txt; echo 2 > a.txt",
    "assumed": "git update-index --assume-unchanged a.txt; echo 2 > a.txt",
    "index of version 4": "git update-index --index-version 4 --untracked-cache; echo 2 > a.txt",
    "conflict": """
        git checkout -q -b side; echo 2 > a.txt; git commit -q -a -m 2; git checkout -q main; echo 3 > a.txt
        git commit -q -a -m 3; git merge -q side || true""",
    "shared objects": "git clone -q --shared . ../other; cd ../other; git gc -q; touch -d 2001-01-01 a.txt",
    "bare by its configuration": "git config core.bare true",
}
"""Shell commands that create each state of a repository with one commit, a.txt and inside/b.txt."""


@pytest.fixture(autouse=True)
def _alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide repositories above the folder, and the git configuration of the user who runs the tests."""
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "nobody")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "nobody@localhost")
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", "/dev/null")
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))


def shell(folder: Path, commands: str) -> Path:
    """Run commands in a fresh repository with a commit; where they end."""
    made = "git init -q -b main .; mkdir inside; echo a > a.txt; echo b > inside/b.txt; git add .; git commit -q -m 1"
    folder.mkdir(exist_ok=True)
    done = subprocess.run(
        ["bash", "-e", "-c", f"{made}\n{commands}\npwd"],
        cwd=folder,
        check=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        timeout=20,
    )
    return Path(done.stdout.splitlines()[-1])


def git(folder: Path, *arguments: str) -> str | None:
    command = ["git", "-C", folder, *arguments]
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=20
    )
    return None if done.returncode else done.stdout


def said_by_git(folder: Path) -> dict[str, str]:
    commit = git(folder, "rev-parse", "--verify", "HEAD")
    changes = git(folder, "status", "--porcelain", "--untracked-files=no", "--ignore-submodules=all")
    if commit is None:
        return {}
    return {"commit": commit.strip(), **({} if changes is None else {"dirty": str(bool(changes)).lower()})}


@pytest.mark.parametrize("state", STATES)
def test_it_is_what_git_says(state: str, tmp_path: Path) -> None:
    folder = shell(tmp_path / "repository", STATES[state])
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.exists()}
    found = git_commit(folder)
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.exists()}
    if state in (
        "damaged configuration",
        "sparse index",
    ):  # git says nothing, or changes the times of objects
        assert set(found) == {"commit"}
    else:
        assert found == said_by_git(folder)


def test_no_repository_no_folder_no_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert git_commit(tmp_path) == {}
    assert git_commit(tmp_path / "missing") == {}
    folder = shell(tmp_path / "repository", "")
    commit = said_by_git(folder)["commit"]
    (tmp_path / "git").write_text("#!/bin/sh\n: > ran\n")
    (tmp_path / "git").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f":.:{tmp_path / 'none'}")  # a git in the current folder is a stranger's
    assert git_commit(folder) == {"commit": commit}
    assert not (tmp_path / "ran").exists()


RUNS = (
    *("core.fsmonitor", "core.hooksPath", "core.sshCommand", "core.pager", "core.editor", "core.gitProxy"),
    *(
        "core.alternateRefsCommand",
        "core.askPass",
        "alias.status",
        "alias.config",
        "alias.check-attr",
        "pager.status",
    ),
    *(
        "credential.helper",
        "gpg.program",
        "gpg.ssh.program",
        "sequence.editor",
        "diff.external",
        "interactive.diffFilter",
    ),
    *(
        "diff.x.command",
        "diff.x.textconv",
        "filter.x.clean",
        "filter.x.smudge",
        "filter.x.process",
        "merge.x.driver",
    ),
    *("trailer.x.command", "uploadpack.packObjectsHook", "browser.x.cmd", "difftool.x.cmd", "man.x.cmd"),
    *("remote.origin.uploadpack", "remote.origin.vcs", "submodule.part.update", "trace2.eventTarget"),
)
"""Settings of git whose value is a program that git runs or a file that git opens."""
HOOKS = (
    *("post-index-change", "post-checkout", "pre-commit", "fsmonitor-watchman", "reference-transaction"),
    *("pre-auto-gc", "sendemail-validate", "post-rewrite", "update", "query-watchman"),
)
PLACES = {
    "config": "",
    "included": "mv .git/config theirs; printf '[include]\npath = ../theirs\n' > .git/config",
    "included here": """
        mv .git/config theirs; printf '[includeIf "gitdir:/**"]\npath = ../theirs\n' > .git/config""",
    "worktree": """
        mv .git/config .git/config.worktree; printf '[core]\nrepositoryformatversion = 1\n' > .git/config
        printf '[extensions]\nworktreeConfig = true\n' >> .git/config""",
}
"""Places of a repository's settings, with the commands that move the settings there."""


@pytest.mark.parametrize("place", PLACES)
def test_nothing_that_a_repository_names_is_run(place: str, tmp_path: Path) -> None:
    """Test all settings that name a program together; git itself runs some of these programs."""
    marker = tmp_path / "marker"
    program = tmp_path / "repository" / "program"
    lines = [
        "printf '#!/bin/sh\\necho $0 $* >> %s\\nexit 1\\n' '" + str(marker) + "' > program; chmod +x program",
        "echo '* filter=x diff=x merge=x' > .gitattributes; git add .; git commit -q -m 2",
        "touch -d 2001-01-01 a.txt; echo 2 > inside/b.txt; mkdir hooks",
        *(f"cp program .git/hooks/{hook}; cp program hooks/{hook}" for hook in HOOKS),
        # a commit that is not there may be fetched by what a promisor remote names
        "git config extensions.partialClone origin; git config remote.origin.promisor true",
        f"git config remote.origin.url 'ext::{program} fetch'; git config protocol.ext.allow always",
        *(f"git config {key} {program}" for key in RUNS if key != "core.hooksPath"),
        "git config core.hooksPath hooks; git config core.repositoryFormatVersion 1",
        f"git config core.attributesFile {tmp_path / 'fifo'}; mkfifo {tmp_path / 'fifo'}; rm -f {marker}",
        PLACES[place],
    ]
    folder = shell(tmp_path / "repository", "\n".join(lines))
    start = time.monotonic()
    found = git_commit(folder)
    assert time.monotonic() - start < 2
    assert not marker.exists()
    assert set(found) == {"commit"}  # what differs could be what a filter made
    head = (folder / ".git" / "HEAD").read_text()
    (folder / ".git" / "HEAD").write_text("1" * 40)  # an object that could be fetched
    assert git_commit(folder) == {"commit": "1" * 40}
    assert not marker.exists()
    (tmp_path / "fifo").unlink()
    (folder / ".git" / "HEAD").write_text(head)
    git(folder, "status")
    assert marker.exists()  # so the trap works


FILES = (
    *(
        "HEAD",
        "config",
        "config.worktree",
        "index",
        "packed-refs",
        "refs/heads/main",
        "commondir",
        "info/attributes",
    ),
    *("objects/info/alternates", "sharedindex." + "1" * 40, "../.gitattributes", "../a.txt", "../.git"),
)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("kind", ["pipe", "link to a pipe", "link out", "folder", "endless"])
def test_no_file_hangs_it_or_leads_it_out(
    file: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(repository, "SECONDS", 0.3)
    folder = shell(tmp_path / "repository", "git config extensions.worktreeConfig true; git pack-refs --all")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "secret").write_text(secret := "5ec2e7" * 6 + "5ec2")
    path = folder / ".git" / file
    if path.is_dir():
        path.rename(tmp_path / "moved")
        path = folder / ".git"
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "endless":
            path.symlink_to("/dev/zero")
        case _:
            path.symlink_to(tmp_path / ("pipe" if kind == "link to a pipe" else "secret"))
    start = time.monotonic()
    found = git_commit(folder)
    assert time.monotonic() - start < 1
    assert secret not in str(found)


OTHERS = {
    "": False,
    "safe.directory=*": True,
    "safe.directory={}": True,
    "safe.directory={}/": True,
    "safe.directory={}/inside": False,
    "safe.directory={.parent}": False,
    "safe.directory=~nobody-of-that-name/x": False,
    "safe.directory=*;safe.directory=": False,
    "safe.directory=;safe.directory={}": True,
    "safe.directory={};safe.directory=/other": True,
}
"""Settings of the user, and whether another user's repository is then read."""


@pytest.mark.parametrize("settings", OTHERS)
def test_a_repository_of_another_user_wants_the_own_consent(
    settings: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shell(tmp_path / "repository", "git config safe.directory '*'; echo 2 > a.txt")
    own = tmp_path / "gitconfig"
    own.touch()
    for one in filter(None, settings.split(";")):
        key, _, value = one.partition("=")
        subprocess.run(["git", "config", "-f", own, "--add", key, value.format(folder)], check=True)
    expected = said_by_git(folder) if OTHERS[settings] else {}
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", str(own))
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    assert git_commit(folder / "inside") == expected
    if settings != "safe.directory={}/":  # which git understands from 2.46 on
        assert said_by_git(folder) == expected


def test_a_family_of_repositories_may_be_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = shell(tmp_path / "repository", "")
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    monkeypatch.setenv("GIT_CONFIG_COUNT", "1")
    monkeypatch.setenv("GIT_CONFIG_KEY_0", "safe.directory")
    for listed, read in ((f"{tmp_path}/*", True), (f"{folder}/*", False)):
        monkeypatch.setenv("GIT_CONFIG_VALUE_0", listed)
        assert bool(git_commit(folder)) is read


@pytest.mark.slow  # four runs, and three processes that import MLflow
def test_whoever_asks_git_asks_it_of_no_strangers_folder(
    framework: Framework, tmp_path: Path, stranger_site: Path
) -> None:
    """MLflow and its libraries would call git without a request."""
    asked, real = tmp_path / "asked", shutil.which("git")
    shell(tmp_path, "")
    programs = tmp_path / "programs"
    programs.mkdir()
    (programs / "git").write_text(f'#!/bin/sh\necho "$PWD $GIT_DIR $*" >> {asked}\nexec {real} "$@"\n')
    (programs / "git").chmod(0o755)
    path = {"PATH": f"{programs}:{os.environ['PATH']}"}
    done = framework(*TINY, "trainer.max_epochs=1", more=path)
    assert done.code == 0, done.out
    again = framework("mode=test", f"checkpoint={done.folder}", folder="test", more=path)
    assert again.code == 0, again.out
    described = json.loads((done.folder / "run.json").read_text())
    (done.folder / "run.json").write_text(json.dumps({**described, "sent": 0}))  # so that sync sends again
    sent = framework("mode=sync", f"mode.run={done.folder}", folder="sync", more=path)
    assert sent.code == 0 and " 0 journal lines" not in f" {sent.out}", sent.out
    subprocess.run(
        [sys.executable, "-c", f"import framework; framework.load({str(done.folder)!r})"],
        cwd=tmp_path,
        env={**os.environ, **path, "PYTHONPATH": str(stranger_site)},
        check=True,
    )
    lines = asked.read_text().splitlines()
    assert len(lines) >= 6  # of each run that was tracked three questions
    for line in lines:
        folder, repository, *_ = line.split()
        assert folder == repository and not Path(repository).is_relative_to(tmp_path), line
