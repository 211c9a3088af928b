"""Retrieval lists and similarity matrices that users already have, for the frames that stay."""

import numpy as np
import pytest
from test_descriptors import KEPT, N_MAP, N_QUERY, SESSIONS, WHOLE, codes, refused, save, session

from taojax.datasets.descriptors import read_views, view_notes
from taojax.datasets.folder import Session

INDEX = np.array([[0, 1, 2], [3, 2, -1], [8, 0, 7], [1, 4, 5], [2, 3, 6], [6, 7, -1], [-1] * 3])
SIMILARITY = np.array([[0.9, 0.8, 0.1]] * N_QUERY, np.float32)
LEFT = np.array([[2, 1, -1], [4, 0, 3], [3, -1, -1], [-1, -1, -1]])
"""Of INDEX for KEPT, in rows of the map that stays."""


def save_lists(path, index=INDEX, similarity=SIMILARITY):
    np.savez(path, index=index.astype(np.int32), similarity=similarity)
    return path


def as_text(separator, *, named, scores=True, header=True):
    lines = ["query,map,similarity" if scores else "query,map"] if header else []
    for query, (row, score) in enumerate(zip(INDEX, SIMILARITY, strict=True)):
        for place, value in zip(row, score, strict=True):
            if place < 0:
                continue
            cells = [f"/n/{query:04d}.png", f"d/{place:04d}.png"] if named else [query, place]
            lines.append(separator.join(map(str, [*cells, *([value] if scores else [])])))
    return "\n".join(lines) + "\n"


def test_an_archive_of_lists_is_renumbered_and_closed_up(tmp_path):
    got = read_views(save_lists(tmp_path / "r.npz"), None, SESSIONS, KEPT)
    np.testing.assert_array_equal(got.index, LEFT)
    want = [[0.9, 0.8, 0], [0.9, 0.8, 0.1], [0.8, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(got.similarity, want)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("r.csv", as_text(",", named=True)),
        ("r.csv", as_text(",", named=False)),
        ("r.csv", as_text(",", named=False).replace("\n", "\r\n") + "\r\n"),
        ("r.txt", as_text(" ", named=True, header=False)),
        ("r.txt", "# hloc\n" + as_text("  ", named=True, header=False)),
    ],
    ids=["csv of names", "csv of numbers", "CRLF", "pairs", "pairs with a comment"],
)
def test_lists_as_text_are_the_same_lists(tmp_path, name, text):
    (tmp_path / name).write_bytes(text.encode())
    got = read_views(tmp_path / name, None, SESSIONS, KEPT)
    same = read_views(save_lists(tmp_path / "same.npz"), None, SESSIONS, KEPT)
    np.testing.assert_array_equal(got.index, same.index)
    np.testing.assert_allclose(got.similarity, same.similarity)
    assert view_notes(tmp_path / name, None) == ()


@pytest.mark.parametrize(("name", "separator"), [("r.csv", ","), ("r.txt", " ")])
def test_lists_without_scores_fall_with_the_rank_and_say_so(tmp_path, name, separator):
    text = as_text(separator, named=True, scores=False, header=name == "r.csv")
    (tmp_path / name).write_text(text)
    got = read_views(tmp_path / name, None, SESSIONS, WHOLE)
    np.testing.assert_array_equal(got.index, INDEX)
    np.testing.assert_allclose(got.similarity[0], [1, 2 / 3, 1 / 3])
    assert "rank" in view_notes(tmp_path / name, None)[0]


def test_lists_of_one_query_need_not_lie_together(tmp_path):
    text = "query,map,similarity\n0,3,0.9\n1,4,0.8\n0,5,0.7\n"
    (tmp_path / "r.csv").write_text(text)
    got = read_views(tmp_path / "r.csv", None, SESSIONS, WHOLE)
    np.testing.assert_array_equal(got.index[:3], [[3, 5], [4, -1], [-1, -1]])


def changed(row, rank, *, index=None, similarity=None):
    def make(path):
        a, b = INDEX.copy(), SIMILARITY.copy()
        if index is not None:
            a[row, rank] = index
        if similarity is not None:
            b[row, rank] = similarity
        save_lists(path, a, b)

    return make


BAD_LISTS = {
    "npz row outside": (changed(3, 1, index=9), ["row 3", "rank 1", "index 9", "0..8"]),
    "npz rising": (changed(3, 1, similarity=0.95), ["row 3", "rank 1", "rises", "distances"]),
    "npz above 1": (changed(3, 0, similarity=7.0), ["row 3", "similarity 7", "rescale"]),
    "npz NaN": (changed(3, 2, similarity=np.nan), ["row 3", "rank 2", "not finite"]),
    "npz other length": (lambda p: save_lists(p, INDEX[:4], SIMILARITY[:4]), ["4 lists", "7"]),
    "npz shapes": (lambda p: save_lists(p, INDEX[:, :2]), ["(7, 2)", "(7, 3)"]),
    "npz of descriptors": (lambda p: np.savez(p, descs=codes(3)), ["lacks", "index", "descs"]),
    "csv unknown name": ("query,map\n0001.png,x.png\n", ["row 2", "map", "'x.png'"]),
    "csv row outside": ("query,map\n0,9\n", ["row 2", "'9'", "none of the 9"]),
    "csv header": ("a,b,c\n0,1,0.5\n", ["row 1", "header", "query,map,similarity"]),
    "csv rising": (
        "query,map,similarity\n0,1,0.5\n1,1,0.9\n0,2,0.6\n",
        ["row 4", "rises", "distances"],
    ),
    "csv above 1": ("query,map,similarity\n0,1,31.5\n", ["row 2", "31.5", "rescale"]),
    "csv NaN": ("query,map,similarity\n0,1,nan\n", ["row 2", "not finite"]),
    "csv cells": ("query,map,similarity\n0,1,0.5\n0,1\n", ["row 3", "2 cells"]),
    "csv empty": ("query,map\n", ["0 data row(s)"]),
    "txt distances": (
        "# query map distance\n0000.png 0001.png 0.1\n0000.png 0002.png 0.4\n",
        ["row 3", "rises", "turn distances round"],
    ),
    "txt numbers of rows": ("7 1 0.5\n", ["row 1", "'7'", "none of the 7"]),
}


@pytest.mark.parametrize("kind", BAD_LISTS)
def test_bad_lists_are_one_line_with_row_and_fix(tmp_path, kind):
    make, words = BAD_LISTS[kind]
    path = tmp_path / f"r.{kind.split()[0]}"
    if isinstance(make, str):
        path.write_text(make)
    else:
        make(path)
    refused(words, path)


def test_numbers_that_are_also_names_of_other_frames_are_refused(tmp_path):
    numbered = Session(tuple("543210"), session(6).poses)
    (tmp_path / "r.csv").write_text("query,map\n0,1\n")
    rows = np.arange(6)
    refused(["names or rows"], tmp_path / "r.csv", None, (numbered,) * 2, (rows, rows))


def matrix(n_map=N_MAP):
    return np.random.default_rng(5).uniform(-1, 1, (N_QUERY, n_map)).astype(np.float32)


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_dense_matrix_becomes_the_best_of_every_row(tmp_path, is_whole):
    part = matrix()[np.ix_(KEPT[1], KEPT[0])]
    path = save(tmp_path / "s.npy", matrix() if is_whole else part)
    got = read_views(path, None, SESSIONS, KEPT)
    np.testing.assert_array_equal(got.index, np.argsort(-part, axis=1))
    np.testing.assert_array_equal(got.similarity, -np.sort(-part, axis=1))
    assert "dense" in view_notes(path, None)[0]


def test_a_wide_matrix_is_cut_to_a_hundred_and_ties_go_by_map_row(tmp_path, monkeypatch):
    monkeypatch.setattr("taojax.datasets.arrays.BLOCK_BYTES", 5000)
    wide = np.round(matrix(300), 2)
    both = session(300), SESSIONS[1]
    path = save(tmp_path / "s.npy", wide)
    got = read_views(path, None, both, (np.arange(300), WHOLE[1]))
    assert got.index.shape == (N_QUERY, 100)
    np.testing.assert_array_equal(got.similarity, -np.sort(-wide, axis=1)[:, :100])
    is_tie = np.diff(got.similarity, axis=1) == 0
    assert is_tie.any()
    assert (np.diff(got.index, axis=1)[is_tie] > 0).all()


BAD_MATRICES = {
    "transposed": (matrix().T, ["(9, 7)", "transpose"]),
    "descriptors": (codes(N_MAP), ["(9, 5)", "7 query", "9 map", "descriptors of both"]),
    "percent": (matrix() * 100, ["row 0", "larger than 1", "rescale"]),
    "NaN": (np.where(np.eye(N_QUERY, N_MAP) > 0, np.nan, 0.5), ["row 0, column 0", "not finite"]),
    "integers": (np.ones((N_QUERY, N_MAP), int), ["int64"]),
}


@pytest.mark.parametrize("kind", BAD_MATRICES)
def test_a_bad_matrix_is_one_line(tmp_path, kind):
    array, words = BAD_MATRICES[kind]
    refused(words, save(tmp_path / "s.npy", array))
