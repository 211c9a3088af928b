"""Retrieval is exact, bounded, and blind to the frames that come after."""

import jax.numpy as jnp
import numpy as np
import pytest

from taojax.runtime import retrieval


def brute_force(places, queries, k):
    unit = lambda a: a / np.linalg.norm(a, axis=1, keepdims=True)
    rows = unit(queries.astype(float)) @ unit(places.astype(float)).T
    order = np.argsort(-rows, axis=1, kind="stable")[:, :k]
    return order, np.take_along_axis(rows, order, axis=1)


def test_top_k_equals_brute_force(rng):
    places, queries = rng.normal(size=(300, 24)), rng.normal(size=(70, 24))
    index, similarity = retrieval.retrieve(places, queries, 100)
    want, cosine = brute_force(places, queries, 100)
    np.testing.assert_allclose(similarity, cosine, atol=1e-5)
    assert (index == want).mean() > 0.999


def test_map_blocks_change_nothing(rng, monkeypatch):
    places, queries = rng.normal(size=(250, 8)), rng.normal(size=(10, 8))
    whole = retrieval.retrieve(places, queries, 30)
    monkeypatch.setattr(retrieval, "MAP_BLOCK", 64)
    blocks = retrieval.retrieve(places, queries, 30)
    np.testing.assert_array_equal(whole[0], blocks[0])
    np.testing.assert_allclose(whole[1], blocks[1], atol=1e-6)


def test_a_shorter_log_gives_the_same_bits(rng):
    places, queries = rng.normal(size=(90, 8)), rng.normal(size=(100, 8))
    long = retrieval.retrieve(places, queries, 20)
    short = retrieval.retrieve(places, queries[:41], 20)
    np.testing.assert_array_equal(long[0][:41], short[0])
    np.testing.assert_array_equal(long[1][:41], short[1])


def test_a_prepared_map_gives_the_same_bits(rng):
    places, queries = rng.normal(size=(90, 8)), rng.normal(size=(70, 8))
    plain = retrieval.retrieve(places, queries, 20)
    prepared = retrieval.retrieve(retrieval.prepare(places), queries, 20)
    np.testing.assert_array_equal(plain[0], prepared[0])
    np.testing.assert_array_equal(plain[1], prepared[1])


@pytest.mark.parametrize("n", [1, 3])
def test_a_few_queries_of_a_prepared_map_equal_brute_force(n, rng):
    places, queries = rng.normal(size=(90, 8)), rng.normal(size=(n, 8))
    unit = jnp.asarray(retrieval.normalise(queries))
    index, similarity = retrieval.top_k(retrieval.prepare(places), unit, 10)
    want, cosine = brute_force(places, queries, 10)
    np.testing.assert_array_equal(index, want)
    np.testing.assert_allclose(similarity, cosine, atol=1e-6)


def test_no_queries_find_nothing(rng):
    index, similarity = retrieval.retrieve(rng.normal(size=(9, 4)), np.zeros((0, 4)), 5)
    assert index.shape == similarity.shape == (0, 5)


def test_rows_are_normalised_alone(rng, monkeypatch):
    rows = rng.normal(size=(50, 8))
    together = retrieval.normalise(rows)
    monkeypatch.setattr(retrieval, "CACHE_NUMBERS", 24)
    np.testing.assert_array_equal(retrieval.normalise(rows), together)
    np.testing.assert_allclose(np.linalg.norm(together, axis=1), 1.0, atol=1e-6)


def test_a_map_smaller_than_k_is_padded_with_no_candidate(rng):
    index, similarity = retrieval.retrieve(rng.normal(size=(12, 4)), rng.normal(size=(3, 4)), 100)
    assert (index[:, :12] >= 0).all()
    assert (index[:, 12:] == -1).all()
    assert (similarity[:, 12:] == 0).all()


@pytest.mark.parametrize("block", [2, 4, 9])
def test_ties_go_to_the_lower_map_row(block, monkeypatch):
    monkeypatch.setattr(retrieval, "MAP_BLOCK", block)
    index, _ = retrieval.retrieve(np.ones((9, 3)), np.ones((2, 3)), 5)
    np.testing.assert_array_equal(index, [[0, 1, 2, 3, 4]] * 2)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_scale_of_descriptors_does_not_matter(scale, rng):
    places, queries = rng.normal(size=(40, 6)), rng.normal(size=(5, 6))
    _, a = retrieval.retrieve(places, queries, 10)
    _, b = retrieval.retrieve(places * scale, queries, 10)
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_zero_descriptor_resembles_nothing():
    _, similarity = retrieval.retrieve(np.eye(4), np.zeros((1, 4)), 4)
    np.testing.assert_array_equal(similarity, np.zeros((1, 4)))
