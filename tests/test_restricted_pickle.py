import builtins
import collections
import copyreg
import functools
import os
import pickle
import struct
import subprocess
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from framework.bodies.restricted_pickle import PickleRefused, load

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


class Calls:
    """Object that is pickled as a call of a function."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def same(found, wanted):
    if isinstance(wanted, np.ndarray | np.generic):
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)
    else:  # a sparse matrix is returned as a dense array
        same(found, wanted.toarray())


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_arrays_and_plain_values_come_back(protocol):
    random = np.random.default_rng(0)
    arrays = {
        "float64": random.normal(size=(5, 3, 2)),
        "float32": random.normal(size=7).astype(np.float32),
        "big endian": random.normal(size=(2, 3)).astype(">f8"),
        "columns first": np.asfortranarray(random.normal(size=(4, 6))),
        "a view": random.normal(size=(6, 6))[::2, 1:],
        "uint32": np.array([[2**32 - 1, 0]], dtype=np.uint32),
        "bool": np.array([True, False]),
        "complex": np.array([1 + 2j]),
        "no numbers": np.zeros((0, 3)),
        "one number": np.array(3.5),
        "text": np.array(["left", "ρ"]),
        "a scalar": np.float32(0.1),
        "sparse columns": sparse.random(6, 50, 0.1, format="csc", random_state=0),
        "sparse rows": sparse.random(6, 50, 0.1, format="csr", random_state=1),
        "sparse places": sparse.random(6, 50, 0.1, format="coo", random_state=2),
        "a sparse array": sparse.csr_array(sparse.random(5, 5, 0.3, random_state=3)),
    }
    plain = {
        "name": "lrotmin",
        3: [1, 2.5, None, True, (b"\x00\xff", "ü")],
        "nested": {"a": {"b": []}},
        "empty": b"",
    }
    found = load(pickle.dumps({**arrays, **plain}, protocol=protocol))
    for name, wanted in arrays.items():
        same(found[name], wanted)
    assert {name: found[name] for name in plain} == plain


def test_what_is_read_is_writable_and_no_view_of_the_file():
    found = load(pickle.dumps(np.arange(3)))
    found[0] = 7
    assert found.tolist() == [7, 1, 2]


# Pickles by Python 2 of {"v": array([[1., 2.]]), "u": array([5], uint32)} and of wrapped arrays, protocol 2: names of
# old modules, data as byte strings
def array_of_python2(raw, dtype, shape):
    short = b"".join(b"K" + bytes([side]) for side in shape)
    close = {1: b"\x85", 2: b"\x86", 3: b"\x87"}[len(shape)]
    return (
        b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01" + short + close
        + b"cnumpy\ndtype\nU\x02" + dtype + b"K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        + b"\x89U" + bytes([len(raw)]) + raw + b"tb"
    )  # fmt: skip


def of_python2(**items):
    return b"\x80\x02}(" + b"".join(b"U" + bytes([len(k)]) + k.encode() + v for k, v in items.items()) + b"u."


def wrapped(module, name, **attributes):
    state = b"}(" + b"".join(b"U" + bytes([len(k)]) + k.encode() + v for k, v in attributes.items()) + b"u"
    return b"c" + module + b"\n" + name + b"\n)\x81" + state + b"b"


TWO = array_of_python2(struct.pack("<2d", 1.0, -2.5), b"f8", (1, 2))


def test_pickles_of_python_2_and_arrays_wrapped_by_an_autodiff_library():
    whole = array_of_python2(struct.pack("<4I", 5, 0, 3, 200), b"u4", (4,))
    places = array_of_python2(struct.pack("<3q", 3, 1, 1), b"i8", (3,))
    old = (
        b"ccopy_reg\n_reconstructor\ncchumpy.ch\nCh\nc__builtin__\nobject\nN\x87R}U\x01x" + TWO + b"sb"
    )  # protocols 0 and 1
    found = load(
        of_python2(
            v=TWO,
            u=whole,
            ch=wrapped(b"chumpy.ch", b"Ch", x=TWO, _dirty_vars=b"]"),
            old=old,
            some=wrapped(
                b"chumpy.reordering", b"Select", a=wrapped(b"chumpy.ch", b"Ch", x=whole), idxs=places,
                preferred_shape=b"K\x03K\x01\x86",
            ),
        )
    )  # fmt: skip
    for name in ("v", "ch", "old"):
        assert found[name].tolist() == [[1.0, -2.5]]
    assert found["u"].tolist() == [5, 0, 3, 200]
    assert found["u"].dtype == np.uint32
    assert found["some"].tolist() == [[200], [0], [0]]


HOSTILE = {
    "a shell": Calls(os.system, "echo no > {mark}"),
    "a process": Calls(subprocess.Popen, "touch {mark}", 0, None, None, None, None, None, True, True),
    "eval": Calls(builtins.eval, "open('{mark}', 'w')"),
    "exec": Calls(builtins.exec, "open('{mark}', 'w')"),
    "getattr": Calls(getattr, "x", "__class__"),
    "open": Calls(open, "{mark}", "w"),
    "import": Calls(builtins.__import__, "os"),
    "a partial": functools.partial(print, "no"),
    "an ordered dictionary": collections.OrderedDict(a=1),
    "a file of NumPy": Calls(np.load, "{mark}"),
    "NumPy writing": Calls(np.savetxt, "{mark}", [1]),
    "NumPy from a string": Calls(np.fromfile, "{mark}"),
    "another reconstructor": Calls(copyreg._reconstructor, Calls, object, None),
    "an array of objects": np.array([{"a": 1}, None], dtype=object),
    "an array with a hidden call": np.array([Calls(os.system, "touch {mark}")], dtype=object),
    "records": np.zeros(2, dtype=[("a", "f8"), ("b", "i4")]),
    "dates": np.array(["2020-01-01"], dtype="datetime64[D]"),
    "a memory map": Calls(np.memmap, "{mark}"),
}


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", HOSTILE)
def test_whatever_could_run_code_is_refused_and_does_not(name, protocol, tmp_path, capfd):
    mark = tmp_path / "mark"
    content = pickle.dumps(HOSTILE[name], protocol=protocol).replace(b"{mark}", bytes(str(mark), "ascii")[:6])
    with pytest.raises(PickleRefused):
        load(content)
    assert not mark.exists()
    assert capfd.readouterr() == ("", "")


def test_the_shell_of_the_test_above_would_have_run(tmp_path):
    mark = tmp_path / "mark"
    pickle.loads(pickle.dumps(Calls(os.system, f"touch {mark}")))
    assert mark.exists()
    mark.unlink()
    with pytest.raises(PickleRefused, match=r"the pickle names (posix|nt)\.system"):
        load(pickle.dumps(Calls(os.system, f"touch {mark}")))
    assert not mark.exists()


RAW = {
    # opcodes written by hand, which no pickler writes
    "a method of an allowed name": b"cnumpy\nndarray.tofile\n.",
    "attributes by dots": b"\x80\x04\x8c\x05numpy\x8c\x0dcore.sys.exit\x93.",
    "a function of this reader": b"cframework.restricted_pickle\nload\n.",
    "the submodule trick": b"cscipy.sparse.linalg\nspsolve\n.",
    "sparse in name only": b"cscipy.sparsecode\ncsc_matrix_evil\n.",
    "attributes set on a class": b"\x80\x02cnumpy\ndtype\n(N}U\x0b__setstate__cnumpy\nndarray\ns\x86b.",
    "a bare class": b"cnumpy\nndarray\n.",
    "an instance of no class": b"(icopy_reg\n_reconstructor\n.",
    "a persistent id": b"Pos.system\n.",
    "an extension": b"\x82\x01.",
    "a list within itself": b"]q\x00h\x00a.",
    "a memo of 32 GiB": b"Nr\xff\xff\xff\xff.",
    "bytes that are not there": b"\x8e\xff\xff\xff\xff\xff\xff\xff\x0fabc.",
    "an array larger than its data": b"\x80\x02" + TWO.replace(b"K\x01K\x02\x86", b"K\x01K\xff\x86") + b".",
    "an array with a negative side": b"\x80\x02"
    + TWO.replace(b"K\x01K\x02\x86", b"J\xff\xff\xff\xffJ\xfe\xff\xff\xff\x86")
    + b".",
    "an array of pointers": b"\x80\x02" + TWO.replace(b"U\x02f8", b"U\x01O") + b".",
    "no state": b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R.",
    "a dictionary with an array for key": b"}" + TWO + b"Ns.",
    # hashing or expanding these could take unlimited time
    "a set": b"\x8f(K\x01\x90.",
    "a frozen set": b"(K\x01\x91.",
    "a tuple for a key": b"}K\x01K\x02\x86Ns.",
    "tuples of the same tuple twice, for a key": b"}K\x01\x85" + b"2\x86" * 40 + b"Ns.",
    "sets of tuples of the same tuple twice": b"\x8f(K\x01\x85" + b"2\x86" * 40 + b"\x90.",
    "keys that all have the hash 0": b"}" + b"".join(
        b"\x8a\x0c" + (number * (2**61 - 1)).to_bytes(12, "little") + b"Ns" for number in range(1, 60)
    ) + b".",
    "a million dictionaries": b"](" + b"}" * 1_000_000 + b"e.",
    "one text in bytes again and again": b"](X\x00\x10\x00\x00" + b"a" * 4096 + b"q\x000"
    + b"c_codecs\nencode\nh\x00X\x06\x00\x00\x00latin1\x86R" * 99 + b"e.",
    "a side of a million digits": b"\x80\x02"
    + TWO.replace(b"K\x01K\x02\x86", b"\x8b\x00\x00\x04\x00" + b"\x7f" * 2**18 + b"2\x86") + b".",
    "an array of ten thousand dimensions": b"\x80\x02"
    + TWO.replace(b"K\x01K\x02\x86", b"(" + b"K\x01" * 10_000 + b"t") + b".",
    "nothing": b"",
    "no pickle": b"solid cube\nfacet normal 0 0 1",
    "cut short": pickle.dumps(np.zeros(100))[:-150],
    "too deep": b"]" * 60 + b"a" * 59 + b".",
}  # fmt: skip


@pytest.mark.parametrize("name", RAW)
def test_hand_made_and_damaged_pickles_are_refused(name):
    with pytest.raises(PickleRefused):
        load(RAW[name])


def test_nesting_does_not_multiply():
    """Check thirty lists, each of which holds the previous one twice; a copy would have a billion items."""
    content = BytesIO()
    pickler = pickle.Pickler(content, protocol=2)
    item = []
    for _ in range(30):
        item = [item, item]
    pickler.dump(item)
    found = load(content.getvalue())
    assert found[0] is found[1]


@pytest.mark.parametrize("kind", ["csc", "csr", "coo"])
def test_sparse_matrices_are_added_up_as_scipy_does(kind):
    """Check unordered entries, several entries at one position, and empty rows and matrices."""
    random = np.random.default_rng(0)
    for rows, columns, count in ((5, 7, 40), (1, 9, 3), (6, 1, 0), (0, 4, 0)):
        places = random.integers(0, (max(rows, 1), max(columns, 1)), (count, 2)).T
        loose = sparse.coo_matrix((random.normal(size=count), tuple(places)), shape=(rows, columns))
        same(load(pickle.dumps(loose.asformat(kind))), loose)


BROKEN = {
    "indices": (
        [0, 1, 7], [0, -1, 2], [0, 1], [0.0, 1.0, 2.0], [[0, 1, 2]], None, np.array([0, 1, 2**64 - 1], np.uint64),
        np.array([0, 1, 2**63 + 2], np.uint64), np.array([0, -(2**63), 2]),
    ),
    "indptr": (
        [0, 3, 3, 3, -1], [0, 3, 3, -1], [0, -1, 2, 3], [0, 3, 2, 3], [0, 1, 2], [0, 1, 2, 2**40], [1, 1, 2, 3], [], 5,
        [0, 1, 2, 3, 3],
        np.array([0, 2**63 - 1, 2**63 + 7, 3], np.uint64),  # rises by less than 2^63 each time, modulo 2^64
        np.array([0, 2**63 - 1, 2**64 - 2, 3], np.uint64), np.array([0, 2**64 - 1, 1, 3], np.uint64),
        np.array([0, 2**62, -(2**63), 3]), np.array([0, 2**63 - 1, -(2**63), 3]),
    ),
    "data": ([1.0], [[1.0]], "abc", [], None, [1j, 1j, 1j]),
    "_shape": ((2, 3), (3, 2), (-3, -3), (2**31, 2**31), (2**62, 0), (3,), (3, 3, 3), None, "ab", (3.0, 3.0)),
}  # fmt: skip


@pytest.mark.parametrize("made", [sparse.csc_matrix, sparse.csr_array, sparse.coo_matrix])
@pytest.mark.parametrize("name", BROKEN)
def test_a_sparse_matrix_that_is_not_whole_is_refused(name, made):
    for value in BROKEN[name]:
        matrix = made(np.eye(3))
        attribute = {"indices": "row", "indptr": "col"}.get(name, name) if made is sparse.coo_matrix else name
        if made is sparse.coo_matrix and attribute in ("row", "col"):
            if name == "indptr" and np.shape(value) == (3,):
                continue  # three numbers may be valid columns
            attribute, value = "coords", (np.arange(3), np.array(value))
        vars(matrix)[attribute] = np.array(value) if isinstance(value, list) else value
        with pytest.raises(PickleRefused):
            load(pickle.dumps(matrix))


@settings(deadline=None, max_examples=300)
@given(st.binary(max_size=60), st.integers(0, 400), st.integers(0, 400))
def test_damage_anywhere_is_refused_or_gives_plain_values(noise, first, last):
    whole = pickle.dumps({"a": np.arange(6.0).reshape(2, 3), "b": sparse.csr_matrix(np.eye(2))}, protocol=2)
    damaged = whole[:first] + noise + whole[last:]
    try:
        found = load(damaged)
    except PickleRefused:
        return
    assert isinstance(
        found, dict | list | tuple | np.ndarray | np.generic | str | bytes | int | float | bool | None
    )
