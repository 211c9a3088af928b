import jax.numpy as jnp
import numpy as np

from taojax.runtime.choice import jump_evidence


def evidence(costs, inlier, recall=1.0):
    costs = jnp.asarray(costs, jnp.float32)
    filled = jnp.ones(costs.shape[1], bool)
    favourite = jnp.asarray(0)
    got = jump_evidence(costs, jnp.asarray(inlier), filled, favourite, jnp.float32(recall))
    return np.asarray(got)


def rows(n_new, good=0.1, n=40):
    """A favourite that fails in the newest frames, and a challenger that explains only those."""
    favourite, challenger = np.full(n, good), np.ones(n)
    favourite[:n_new], challenger[:n_new] = 1.0, good
    return np.stack([favourite, challenger]), favourite < 1.0


def test_evidence_grows_with_every_frame_that_contradicts_the_favourite():
    found = [evidence(*rows(n))[1] for n in range(6)]
    assert (np.diff(found) > 0).all()
    assert found[0] <= 0.0


def test_the_favourite_has_no_evidence_against_itself():
    assert evidence(*rows(5))[0] == 0.0


def test_old_successes_of_the_favourite_do_not_weigh_against_a_jump():
    costs, inlier = rows(4, n=60)
    assert evidence(costs, inlier)[1] == evidence(costs[:, :30], inlier[:30])[1]


def test_a_favourite_that_rarely_finds_support_is_contradicted_by_less():
    costs, inlier = rows(4)
    rarely = inlier & (np.arange(40) % 3 == 0)
    assert evidence(costs, rarely)[1] < evidence(costs, inlier)[1]


def test_frames_before_the_start_say_nothing():
    costs, inlier = rows(4)
    filled = jnp.arange(40) < 4
    got = jump_evidence(
        jnp.asarray(costs, jnp.float32),
        jnp.asarray(inlier),
        filled,
        jnp.asarray(0),
        jnp.float32(1.0),
    )
    assert np.isfinite(got).all()


def test_a_map_that_confuses_its_places_forgets_a_jump_sooner():
    apart, alike = ([evidence(*rows(n, n=60), recall=r)[1] for n in (10, 20)] for r in (1.0, 0.5))
    assert apart[1] > apart[0] > alike[0]
    # Half the recall halves the evidence of a frame and the frames that count.
    assert alike[1] < 0.5 * apart[1]
