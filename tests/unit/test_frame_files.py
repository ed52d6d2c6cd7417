"""Which frame a file means: examples of each rule, and random folders."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from pipeline.clip.frame_files import (
    ClipFrames,
    match_files,
    match_names,
    natural_key,
    number_files,
    numbers_in,
    stem_of,
)
from pipeline.errors import UserError

HERE = Path("folder")
FAST = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def video(count):
    return ClipFrames(range(count))


def pictures(names):
    """Pictures whose frame numbers are their places."""
    return ClipFrames(range(len(names)), dict(enumerate(names)))


def frames_of(names, clip, counted_from=None):
    match = match_names(names, clip, HERE, counted_from)
    return [match.frames.get(name) for name in names]


def test_ten_comes_after_two():
    names = ["frame_10.jpg", "frame_2.jpg", "frame_1.jpg", "a2b10.png", "a2b9.png"]
    expected = ["a2b9.png", "a2b10.png", "frame_1.jpg", "frame_2.jpg", "frame_10.jpg"]
    assert sorted(names, key=natural_key) == expected


@pytest.mark.parametrize(
    ("name", "stem"),
    [("a/b/0001.png", "0001"), ("a\\0001.json", "0001"), ("take.0001", "take.0001"), ("1.jpg.png", "1.jpg")],
)
def test_a_stem_has_neither_folders_nor_the_last_suffix(name, stem):
    assert stem_of(name) == stem


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["0000_person1.json", "0001_person1.json"], [0, 1]),
        (["0007_person1.json"], [7]),
        (["cam2_0003.png", "cam2_0004.png"], [3, 4]),
        (["clip2_000000000011_keypoints.json", "clip2_000000000012_keypoints.json"], [11, 12]),
        (["results_3.json", "results_12.json"], [3, 12]),
        (["mesh-f00012_smplx.pkl", "mesh-f00013_smplx.pkl"], [12, 13]),
        (["frame1_t40.png", "frame2_t80.png", "frame3_t120.png"], [1, 2, 3]),
        (["12.png", "take 5.png"], [12, 5]),
    ],
)
def test_the_number_is_what_tells_names_apart(names, numbers):
    assert [numbers_in(names)[name] for name in names] == numbers


def test_equal_names_come_first_whatever_their_order():
    clip = pictures([f"frame_{k}.jpg" for k in (1, 2, 3, 10, 11)])
    assert frames_of([f"frame_{k}.png" for k in (1, 10, 11, 2, 3)], clip) == [0, 3, 4, 1, 2]
    assert frames_of(["b.png", "a.png"], pictures(["a.jpg", "b.jpg"])) == [1, 0]


@pytest.mark.parametrize(
    "pattern", ["{}.jpg.png", "{}_mask.png", "{}.person1.json", "results_{}.json", "{}_keypoints.json"]
)
def test_a_picture_s_name_with_the_same_text_beside_it_is_that_picture(pattern):
    names = [f"shot3_{k}" for k in (4, 5, 12)]
    clip = pictures([f"{name}.jpg" for name in names])
    assert frames_of([pattern.format(name) for name in names], clip) == [0, 1, 2]
    words = pictures(["left.jpg", "right.jpg"])
    assert frames_of([pattern.format(name) for name in ("right", "left")], words) == [1, 0]


def test_equal_numbers_are_enough_where_pictures_have_them():
    clip = pictures([f"IMG_{k:04d}.JPG" for k in range(20, 26)])
    assert frames_of(["22.json", "20.json", "25.json"], clip) == [2, 0, 5]
    padded = pictures(["08.jpg", "09.jpg", "10.jpg"])
    assert frames_of(["8.png", "9.png", "10.png"], padded) == [0, 1, 2]


def test_places_count_where_the_pictures_numbers_do_not_fit():
    clip = pictures([f"IMG_{k:04d}.JPG" for k in range(20, 26)])
    assert frames_of([f"{k}.json" for k in range(6)], clip) == list(range(6))
    assert frames_of([f"{k}.json" for k in range(1, 7)], clip) == list(range(6))


@pytest.mark.parametrize(
    ("numbers", "count", "first"),
    [
        (range(16), 16, 0), (range(1, 17), 16, 1), (range(1, 16, 2), 16, 1), (range(0, 16, 2), 16, 0),
        (range(1, 16), 16, 1), ([3, 9, 16], 16, 1), ([3, 9, 12], 16, 0), ([0], 16, 0), ([16], 16, 1),
        (range(1, 5), 0, 1), (range(5), 0, 0), ([7], 0, 0),
    ],
)  # fmt: skip
def test_counted_from_one_is_recognised(numbers, count, first):
    names = [f"image{number:05d}.png" for number in numbers]
    match = match_names(names, video(count), HERE)
    assert [match.frames[name] for name in names] == [number - first for number in numbers]
    assert match.counted_from == first and f"counted from {first}" in match.how


def test_what_fits_neither_is_a_stranger_and_never_moved():
    match = match_names(["3.png", "77.png"], video(10), HERE)
    assert match.frames == {"3.png": 3} and match.strangers == ("77.png",)
    assert len(match_names([f"{k}.png" for k in range(3, 11)], video(8), HERE).strangers) > 0
    clip = pictures([f"frame_{k}.jpg" for k in range(12)])
    assert match_names([f"frame_{k}.png" for k in range(1, 13)], clip, HERE).strangers == ("frame_12.png",)


def test_the_user_s_word_counts_before_all_rules():
    clip = pictures([f"frame_{k}.jpg" for k in range(12)])
    assert frames_of([f"frame_{k}.png" for k in range(1, 13)], clip, 1) == list(range(12))
    assert frames_of(["1.json", "2.json"], video(16), 0) == [1, 2]
    assert frames_of(["1000.json", "1002.json"], video(16), 1000) == [0, 2]


@pytest.mark.parametrize("names", [["3.png", "frame_3.png"], ["a4.png", "b4.png"], ["1.png", "01.png"]])
def test_two_names_of_one_frame_are_refused_by_name(names):
    with pytest.raises(UserError, match=rf"'{names[0]}' and '{names[1]}'|'{names[1]}' and '{names[0]}'"):
        match_names(names, video(16), HERE)


def test_files_of_a_folder(tmp_path):
    for name in ("2.png", "10.PNG", "x.txt", ".3.png", "readme.png"):
        (tmp_path / name).touch()
    found, match = match_files(tmp_path, (".png",), video(11))
    assert {frame: file.name for frame, file in found.items()} == {2: "2.png", 10: "10.PNG"}
    assert not match.strangers and number_files(tmp_path, (".png",)) == found
    assert number_files(tmp_path / "nowhere", (".png",)) == {}


# Random folders. A name is a prefix, a number, padded or not, and what follows it.

WORDS = st.sampled_from(["", "frame_", "img", "clip2_", "cam01-", "a b ", "2023-01-02_", "video_3_take7_"])
AFTER = st.sampled_from(["", "_person1", "_keypoints", "_mask", "-v2", "_rendered", ".jpg", "_smplx_000"])
PADDING = st.integers(0, 8)


@st.composite
def folders(draw, least=2):
    """Names by number, and how many frames there are."""
    count = draw(st.integers(least, 40))
    before, after, padding = draw(WORDS), draw(AFTER), draw(PADDING)
    return count, lambda number: f"{before}{number:0{padding}d}{after}.png"


@FAST
@given(folders(), st.sets(st.integers(0, 39), min_size=2), st.sampled_from([0, 1]), st.randoms())
def test_any_names_of_a_video_s_frames_are_read_right(folder, chosen, first, random):
    """With any gaps, where the names themselves say what they count from."""
    count, name = folder
    chosen = {number for number in chosen if number < count} | ({0} if first == 0 else {count - 1})
    assume(len(chosen) > 1)
    names = {name(number + first): number for number in chosen}
    shuffled = list(names)
    random.shuffle(shuffled)
    match = match_names(shuffled, video(count), HERE)
    assert match.frames == names and match.strangers == ()
    assert list(match.frames.values()) == sorted(chosen)


@FAST
@given(folders(), st.sets(st.integers(0, 39), min_size=1), st.integers(0, 1000), PADDING, AFTER)
def test_any_names_of_pictures_find_theirs(folder, chosen, offset, padding, after):
    """Pictures have any numbers; files repeat their names, with or without more, or their numbers alone."""
    count, name = folder
    clip = pictures([name(number + offset) for number in range(count)])
    chosen = sorted(number for number in chosen if number < count)
    assume(chosen)
    same = {f"{stem_of(name(number + offset))}{after}.json": number for number in chosen}
    assert match_names(same, clip, HERE).frames == same
    if numbers_in(clip.names.values()) == {clip.names[k]: k + offset for k in range(count)}:
        numbers = {f"{number + offset:0{padding}d}.json": number for number in chosen}
        assert match_names(numbers, clip, HERE).frames == numbers


@FAST
@given(folders(), st.integers(2, 500))
def test_any_other_offset_is_refused_or_said(folder, offset):
    """Nothing is shifted in silence: numbers that do not fit are strangers, or the user says the offset."""
    count, name = folder
    names = [name(number + offset) for number in range(count)]
    assert match_names(names, video(count), HERE).strangers
    assert frames_of(names, video(count), offset) == list(range(count))


@FAST
@given(st.lists(st.text(alphabet="ab_.-019", min_size=1, max_size=9), min_size=1, max_size=8, unique=True))
def test_any_names_give_frames_of_the_clip_once_each_or_an_error(names):
    names = [f"{name}.png" for name in names]
    for clip in (video(12), video(0), pictures([f"a_{k}.png" for k in range(12)])):
        try:
            match = match_names(names, clip, HERE)
        except UserError:
            continue
        assert len(set(match.frames.values())) == len(match.frames)
        assert not clip.numbers or set(match.frames.values()) <= set(clip.numbers)
        assert not set(match.frames) & set(match.strangers)
