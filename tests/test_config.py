"""Settings: one file in, one file out, unknown keys and wild values refused."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taojax.config import AuditConfig, Config, StreamConfig, from_toml, replace, to_toml
from taojax.errors import ConfigError


@settings(max_examples=30, deadline=None)
@given(
    st.integers(3, 500),
    st.sampled_from(["rank", "joint"]),
    st.floats(0, 1e6, allow_subnormal=False),
    st.floats(1e-3, 100, allow_subnormal=False),
)
def test_toml_round_trip_is_exact(tmp_path_factory, window, association, weight, radius):
    config = Config(
        stream=StreamConfig(window=window, association=association, lambda_velocity=weight),
        audit=AuditConfig(r_in_m=radius, r_out_m=radius * 2),
        seed=window,
    )
    path = tmp_path_factory.mktemp("config") / "config.toml"
    path.write_text(to_toml(config))
    assert from_toml(path) == config


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("[stream]\nwindw = 20", "unknown key"),
        ("[strem]\nwindow = 20", "unknown entry"),
        ("[stream]\nwindow = 2", "window must lie in"),
        ("[stream]\nwindow = 20.5", "expected int"),
        ("[stream]\nlambda_velocity = -1", "lambda_velocity"),
        ("[stream]\nlambda_velocity = nan", "lambda_velocity"),
        ("[stream]\nlambda_velocity = true", "expected float"),
        ("[stream]\nrefine = 1", "expected bool"),
        ('[stream]\nassociation = "best"', "association"),
        ("[audit]\nr_in_m = 10\nr_out_m = 5", "r_out_m"),
        ("seed = -1", "seed"),
        ("stream = 3", "unknown entry"),
        ("[stream", "TOML"),
    ],
)
def test_a_bad_file_is_refused_with_its_name(body, words, tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(body)
    with pytest.raises(ConfigError, match=words) as caught:
        from_toml(path)
    assert "c.toml" in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml"):
        from_toml(tmp_path / "none.toml")


def test_replace_finds_fields_wherever_they_live():
    config = replace(Config(), {"window": 9, "r_in_m": 2.0, "seed": 4, "branches": None})
    assert (config.stream.window, config.audit.r_in_m, config.seed) == (9, 2.0, 4)
    assert config.stream.branches == StreamConfig().branches


def test_replace_refuses_unknown_names():
    with pytest.raises(ConfigError, match="wndow"):
        replace(Config(), {"wndow": 9})


def test_settings_of_an_earlier_build_are_refused_with_what_to_do(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text("[stream]\njoint_window = 60\n")
    with pytest.raises(ConfigError, match="joint_window of an earlier build: delete them, or"):
        from_toml(path)
