"""Places are known again by their descriptors, and told apart from those that look like them."""

import numpy as np
import pytest
from rgbd_features import random_descriptors

from sceneslam.views.place_index import PlaceIndex


def seen_again(descriptors, rng, *, flipped_bits=20, share=0.5):
    """What another view has of a place: a share of it, some bits of each descriptor changed."""
    kept = descriptors[rng.permutation(len(descriptors))[: int(share * len(descriptors))]].copy()
    for row in kept:
        for bit in rng.permutation(256)[:flipped_bits]:
            row[bit // 8] ^= 1 << (bit % 8)
    return np.concatenate([kept, random_descriptors(rng, len(descriptors) - len(kept))])


def index_of(places):
    index = PlaceIndex()
    for place_id, descriptors in enumerate(places):
        index.insert(place_id, descriptors)
    return index


def test_place_is_known_by_half_of_its_corners_with_a_twelfth_of_their_bits_changed():
    rng = np.random.default_rng(0)
    places = [random_descriptors(rng, 500) for _ in range(40)]
    index = index_of(places)
    for place_id in range(0, 40, 5):
        alike = index.alike(seen_again(places[place_id], rng))
        assert alike[0].place_id == place_id
        assert alike[0].ratio > 2 * alike[1].ratio


def test_words_that_all_places_have_say_nothing():
    rng = np.random.default_rng(1)
    everywhere = random_descriptors(rng, 300)
    own = [random_descriptors(rng, 30) for _ in range(20)]
    index = index_of([np.concatenate([everywhere, corners]) for corners in own])
    alike = index.alike(np.concatenate([everywhere, own[7]]))
    assert alike[0].place_id == 7 and alike[1].ratio < 0.5 * alike[0].ratio


def test_forgotten_place_is_not_found_and_leaves_no_trace():
    rng = np.random.default_rng(2)
    places = [random_descriptors(rng, 200) for _ in range(3)]
    index, never = index_of(places), index_of(places[:2])
    index.remove(2)
    assert [likeness.place_id for likeness in index.alike(places[2])] == [
        likeness.place_id for likeness in never.alike(places[2])
    ]
    assert index.alike(places[0])[0].ratio == pytest.approx(never.alike(places[0])[0].ratio)


def test_only_the_places_asked_for_are_compared():
    rng = np.random.default_rng(3)
    places = [random_descriptors(rng, 100) for _ in range(4)]
    assert [found.place_id for found in index_of(places).alike(places[0], [2, 3])] == [2, 3]
    assert index_of(places).alike(places[0], []) == []
