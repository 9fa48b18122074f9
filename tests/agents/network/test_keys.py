"""Whose a key is."""

import pytest

from agents.network.keys import Keys


@pytest.mark.parametrize("key", ["**", "park/**", "lab/KH01/pose", "park", "park/", "park//pose", ""])
def test_a_key_on_which_many_hear_is_nobodys(key):
    assert Keys("park").whose(key) is None


def test_a_robots_key_is_its_own():
    keys = Keys("park")
    assert keys.whose(keys.pose("KH01")) == keys.whose(keys.alive("KH01")) == "KH01"


def test_tokens_of_owners_name_their_session():
    alive = Keys("park").alive("KH01")
    assert Keys.session_of(Keys.life(alive, "f00d")) == "f00d"
    assert Keys.session_of(Keys.claim(alive, Keys.rank(1e9, "f00d"))) == "f00d"
    assert Keys.session_of(alive) is None
    assert Keys.session_of("park/run/conductor") is None
