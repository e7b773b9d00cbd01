"""Many scenes in one picture: each in its place, in its own scale, told apart."""

import itertools

import numpy as np
import pytest

from slipcar.envs import Scenario

pygame = pytest.importorskip("pygame")

from slipcar.envs.overlay import Overlay  # noqa: E402
from slipcar.envs.pictures.gallery import Gallery  # noqa: E402
from slipcar.envs.pictures.scene import Scene  # noqa: E402
from slipcar.envs.pictures.sprites import CRASH  # noqa: E402
from slipcar.envs.pictures.tiles import Tiles  # noqa: E402

WORLDS = [Scenario.random(seed, turned=True) for seed in range(5)]


def starts(scenarios):
    return [scenario.start[None] for scenario in scenarios]


def draw(tiles, scenarios, **options):
    return tiles.draw(starts(scenarios), **{"collided": [False] * len(scenarios), **options})


@pytest.mark.parametrize("count", [1, 2, 3, 5, 16, 17, 64])
def test_the_grid_is_near_square_and_what_codecs_want(count):
    tiles = Tiles([WORLDS[0]] * count)
    assert len(tiles) == count
    assert tiles.columns * (tiles.rows - 1) < count <= tiles.columns * tiles.rows
    assert 0 <= tiles.columns - tiles.rows <= 1
    assert tiles.size[0] % 16 == tiles.size[1] % 16 == 0
    assert max(tiles.size) <= 1216
    assert min(tiles.tile) >= 60


@pytest.mark.parametrize("count", [0, 65])
def test_the_number_of_tiles_is_checked(count):
    with pytest.raises(ValueError, match=f"1 to 64 tiles, not {count}"):
        Tiles([WORLDS[0]] * count)


def test_each_tile_shows_its_own_scene():
    """What a scene of the tile's size draws by itself, but for number and bar."""
    tiles = Tiles(WORLDS)
    trails = [np.vstack([w.start, 0.5 * (w.start + w.goal), w.goal]) for w in WORLDS]
    picture = tiles.draw(trails, collided=[False] * 5)
    assert picture.shape == (tiles.size[1], tiles.size[0], 3)
    shown = tiles.cut(picture)
    width, height = tiles.tile
    for world, path, tile in zip(WORLDS, trails, shown, strict=True):
        pixels = np.zeros((height, width, 3), np.uint8)
        surface = pygame.image.frombuffer(pixels, tiles.tile, "RGB")
        Scene(pygame, world, tiles.tile, surface).draw(surface, path, collided=False)
        np.testing.assert_array_equal(tile[24:-4], pixels[24:-4])
    for one, other in itertools.combinations(shown, 2):
        assert (one != other).any()


def test_a_collision_frames_its_own_tile_alone():
    tiles = Tiles(WORLDS)
    clear = tiles.cut(draw(tiles, WORLDS))
    hit = tiles.cut(draw(tiles, WORLDS, collided=np.arange(5) == 3))
    for i, (before, after) in enumerate(zip(clear, hit, strict=True)):
        edge = np.concatenate([after[30:-4, 0], after[30:-4, -1], after[-1, :]])
        assert (edge == CRASH).all() == (i == 3)
        assert (before == after).all() == (i != 3)


def test_bars_grow_with_time():
    tiles = Tiles([WORLDS[0]] * 2)
    world = WORLDS[0]
    trail = np.tile(world.start, (world.nodes, 1))
    k = (world.nodes - 1) // 2
    picture = tiles.draw([trail[: k + 1], trail], collided=[False] * 2)
    timed = tiles.draw([trail[:1]] * 2, collided=[False] * 2, times=[k * world.dt, world.horizon])
    for shown in (picture, timed):
        half, whole = ((tile[-1] < 200).all(axis=-1).sum() for tile in tiles.cut(shown))
        assert whole == tiles.tile[0]
        assert abs(half - k / (world.nodes - 1) * tiles.tile[0]) <= 1


def test_a_tile_enters_another_world_and_the_others_stay():
    tiles = Tiles(WORLDS)
    before = tiles.cut(draw(tiles, WORLDS))
    changed = [*WORLDS[:2], Scenario.named("paper"), *WORLDS[3:]]
    for i, world in enumerate(changed):
        tiles.enter(i, world)
    after = tiles.cut(draw(tiles, WORLDS))  # the same trails
    assert [bool((a != b).any()) for a, b in zip(before, after, strict=True)] == [
        False, False, True, False, False,
    ]  # fmt: skip
    with pytest.raises(ValueError, match="numbered 0 to 4, not 5"):
        tiles.enter(5, WORLDS[0])


def test_overlays_are_drawn_in_their_tiles():
    tiles = Tiles(WORLDS[:2])
    plan = Overlay(np.vstack([WORLDS[1].start, WORLDS[1].goal]))
    before = tiles.cut(draw(tiles, WORLDS[:2]))
    after = tiles.cut(draw(tiles, WORLDS[:2], overlays=[None, plan]))
    assert (before[0] == after[0]).all()
    assert (before[1] != after[1]).any()


def test_each_tile_needs_its_trail():
    tiles = Tiles(WORLDS)
    with pytest.raises(ValueError, match="trails must be 5, one for each tile, not 2"):
        tiles.draw(starts(WORLDS[:2]), collided=[False] * 5)
    with pytest.raises(ValueError, match="collided must be 5"):
        draw(tiles, WORLDS, collided=[False])


def test_a_window_shows_what_is_drawn_off_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = Tiles(WORLDS, human=True, fps=1000)
    assert draw(window, WORLDS) is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, draw(Tiles(WORLDS), WORLDS))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert draw(window, WORLDS) is None
    assert not pygame.display.get_init()
    assert draw(window, WORLDS) is None
    window.close()


# ---------------------------------------------------------------- episodes of a vector environment


def test_a_gallery_keeps_the_trails_of_running_episodes():
    """Also where some are reset on their own, and their worlds change."""
    gallery, everyone = Gallery(3, human=False, fps=8), np.arange(3)
    paths = [np.linspace(w.start, w.goal, 6) for w in WORLDS]
    gallery.record(np.stack([p[0] for p in paths[:3]]), everyone, moved=False)
    for k in (1, 2, 3):
        gallery.record(np.stack([p[k] for p in paths[:3]]), everyone[:0], moved=True)
    now = np.stack([paths[0][3], paths[4][0], paths[2][3]])
    gallery.record(now, np.array([1]), moved=False)  # a reset_mask
    now = np.stack([paths[0][4], paths[4][1], WORLDS[2].start])
    gallery.record(now, np.array([2]), moved=True)  # the others step, an autoreset
    now[:] = 0.0
    worlds, hit = [WORLDS[0], WORLDS[4], WORLDS[2]], np.array([False, True, False])
    tiles = Tiles(worlds)
    expected = tiles.draw([paths[0][:5], paths[4][:2], paths[2][:1]], collided=hit)
    np.testing.assert_array_equal(gallery.draw(worlds, hit), expected)
    for frame, tile in zip(gallery.frames(worlds, hit), tiles.cut(expected), strict=True):
        np.testing.assert_array_equal(frame, tile)


def test_a_window_shows_the_first_of_many(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with pytest.raises(ValueError, match="num_envs must be at most 64 for it, not 1000"):
        Gallery(1000, human=False, fps=8)
    gallery = Gallery(1000, human=True, fps=1000)
    assert gallery.shown == 16
    world = WORLDS[0]
    gallery.record(np.tile(world.start, (1000, 1)), np.arange(1000), moved=False)
    assert gallery.frames([world] * 1000, np.zeros(1000, bool)) is None
    assert pygame.display.get_surface().get_size() == Tiles([world] * 16).size
    gallery.close()
    assert not pygame.display.get_init()
