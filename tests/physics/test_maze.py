"""Mazes from a cell map: walls, clearance, the uniform sampler, and own mazes."""

from __future__ import annotations

import itertools
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats

from rcg_jax.config.settings import Config
from rcg_jax.io.starts_file import hash_starts
from rcg_jax.physics.jit import jit
from rcg_jax.runs.program import load_program
from rcg_jax.tasks import PointMaze, make_task
from rcg_jax.tasks.maze import Maze

#: G-shaped; U-shaped; a room with pillars, one of them L-shaped; a cross; one cell.
MAPS = {
    "G": PointMaze.maze.rows,
    "U": ("#####", "#...#", "###.#", "#...#", "#####"),
    "pillars": ("########", "#......#", "#.##.#.#", "#.#....#", "#....#.#", "########"),
    "cross": ("#######", "#..#..#", "#.....#", "##...##", "#.....#", "#..#..#", "#######"),
    "one cell": ("###", "#.#", "###"),
}


@pytest.fixture(params=MAPS)
def maze(request: pytest.FixtureRequest) -> Maze:
    return Maze(MAPS[request.param], origin=(-3.0, 1.5), size=1.5)


def brute_clearance(maze: Maze, xy: np.ndarray) -> np.ndarray:
    """Distance of points (N, 2) to the nearest wall cell, cell by cell."""
    best = np.full(len(xy), np.inf)
    for i, j in zip(*np.nonzero(~maze.is_open)):
        centre = np.array(maze.origin) + maze.size * np.array([j, i])
        best = np.minimum(best, np.linalg.norm(np.maximum(np.abs(xy - centre) - maze.size / 2, 0), axis=1))
    return best


def points(maze: Maze, num: int = 4000) -> np.ndarray:
    return np.random.default_rng(0).uniform(*maze.bounds, (num, 2)).astype(np.float32)


class TestCellMap:
    def test_rows_are_seen_from_above(self) -> None:
        maze = Maze(("####", "#..#", "##.#", "####"), origin=(10, 20), size=2)
        np.testing.assert_array_equal(maze.open_centres, [[14, 22], [12, 24], [14, 24]])
        np.testing.assert_array_equal(maze.bounds, [[9, 19], [17, 27]])

    @pytest.mark.parametrize(
        ("rows", "says"),
        [
            (("###", "##"), "same length"),
            ((), "same length"),
            (("###", "#x#", "###"), "must consist of #"),
            (("###", "###"), "must have an open cell"),
            (("###", "#..", "###"), "walls all around"),
            (("#.#", "#.#", "###"), "walls all around"),
        ],
    )
    def test_wrong_maps_are_refused(self, rows: tuple[str, ...], says: str) -> None:
        with pytest.raises(ValueError, match=says):
            Maze(rows, origin=(0, 0))


class TestWay:
    def test_leads_by_steps_from_a_point(self) -> None:
        maze = Maze(("######", "#..#.#", "#....#", "######"), origin=(0, 0), size=1)
        way = maze.way_from((4.4, 1.6))
        assert way[:4].tolist() == [[4, 2], [4, 1], [3, 1], [2, 1]]
        assert {tuple(x) for x in way[4:6].tolist()} == {(2, 2), (1, 1)}  # three steps from the first, both
        assert way[6:].tolist() == [[1, 2]]

    def test_reaches_every_cell_once_each_beside_an_earlier_one(self, maze: Maze) -> None:
        for centre in maze.open_centres:
            way = maze.way_from(centre)
            np.testing.assert_array_equal(way[0], centre)
            assert sorted(way.tolist()) == sorted(maze.open_centres.tolist())
            steps = [0]
            for k in range(1, len(way)):
                beside = np.isclose(np.abs(way[:k] - way[k]).sum(1), maze.size)
                steps.append(1 + min(np.array(steps)[beside]))
            assert steps == sorted(steps)

    @pytest.mark.parametrize("xy", [(0, 0), (2, 1), (-7, 1), (1, 40)])
    def test_begins_in_the_open(self, xy: tuple[float, float]) -> None:
        with pytest.raises(ValueError, match="must be in an open cell"):
            Maze(("####", "#.##", "####"), origin=(0, 0), size=1).way_from(xy)


class TestWalls:
    def test_rectangles_cover_the_walls_and_nothing_else(self, maze: Maze) -> None:
        covered = np.zeros(maze.is_open.shape, bool)
        for top, left, bottom, right in maze.wall_rectangles():
            covered[top:bottom, left:right] = True
        np.testing.assert_array_equal(covered, ~maze.is_open)


class TestClearance:
    def test_equals_the_distance_to_the_nearest_wall_cell(self, maze: Maze) -> None:
        xy = points(maze)
        np.testing.assert_allclose(jit(jax.vmap(maze.clearance))(xy), brute_clearance(maze, xy), atol=2e-6)

    def test_is_zero_outside_of_the_map(self, maze: Maze) -> None:
        low, high = maze.bounds
        outside = np.array([low - 1, high + 1, [low[0] - 3, high[1] - 0.1]], np.float32)
        np.testing.assert_array_equal(jax.vmap(maze.clearance)(outside), 0)


class TestSampler:
    CLEARANCE = 0.3

    def test_uniform_over_what_is_clear_of_walls(self, maze: Maze) -> None:
        """Over the cells, and within each over a grid of 3 x 3; expected shares from a fine grid of points."""
        num = 20_000
        xy = np.asarray(jit(lambda key: maze.sample(key, num, self.CLEARANCE))(jax.random.key(0)))
        assert brute_clearance(maze, xy).min() > self.CLEARANCE - 1e-5
        fine = (np.arange(60) + 0.5) / 60 - 0.5
        grid = (maze.open_centres[:, None] + maze.size * np.array(list(itertools.product(fine, fine)))).reshape(-1, 2)
        grid = grid[brute_clearance(maze, grid) > self.CLEARANCE]
        observed, expected = (np.bincount(_ninths(maze, x), minlength=9 * maze.is_open.size) for x in (xy, grid))
        some = expected > 0
        assert not observed[~some].any()
        expected = expected[some] * num / expected.sum()
        assert stats.chisquare(observed[some], expected).pvalue > 1e-3

    def test_too_wide_for_a_corridor(self) -> None:
        with pytest.raises(ValueError, match="clearance=1: must be less than half a cell, 1"):
            PointMaze.maze.sample(jax.random.key(0), 5, 1.0)


def _ninths(maze: Maze, xy: np.ndarray) -> np.ndarray:
    """Number of the ninth of a cell that each point lies in."""
    x, y = ((xy - maze.bounds[0]) / maze.size * 3).astype(int).T
    cell = y // 3 * maze.is_open.shape[1] + x // 3
    return cell * 9 + y % 3 * 3 + x % 3


class TestOwnMaze:
    class Mine(PointMaze):
        name = "my_maze"
        maze = Maze(("######", "#..#.#", "#....#", "######"), origin=(0.0, 0.0), size=1.0)
        goal = (4.0, 2.0)

    def test_has_feasible_starts_of_its_own(self) -> None:
        task = self.Mine("native")
        assert task.feasible_file == Path(__file__).with_name("test_maze.Mine.npz")
        starts = task.feasible_starts()
        assert starts.capacity == 10_000
        np.testing.assert_array_equal(starts.qpos, self.Mine("native").feasible_starts().qpos)
        assert brute_clearance(task.maze, np.asarray(starts.qpos)).min() > 0.1 - 1e-5

    def test_can_be_trained_without_a_file_of_starts(self, tmp_path: Path) -> None:
        """As docs/custom_tasks.md has it: the sampler's starts are those of the evaluation, and have a hash as well."""
        (tmp_path / "snail.py").write_text(
            "from rcg_jax.tasks.maze import Maze\nfrom rcg_jax.tasks.point_maze import PointMaze\n\n\n"
            "class Snail(PointMaze):\n"
            '    maze = Maze(rows=("#####", "#...#", "###.#", "#...#", "#####"), origin=(-4.0, -4.0))\n'
            "    goal = (-2.0, -2.0)\n"
        )
        name = f"{tmp_path / 'snail.py'}:Snail"
        program = load_program(Config(task=name, engine="native"))
        starts = make_task(name, "native").feasible_starts()
        assert program.starts_sha256 == hash_starts(np.asarray(starts.qpos))

    def test_needs_a_goal_in_the_open(self) -> None:
        with pytest.raises(ValueError, match=r"goal=\(3.0, 2.0\): must be in an open cell"):
            type("Walled", (self.Mine,), {"goal": (3.0, 2.0), "__module__": __name__})("native")

    def test_needs_a_way_from_every_cell_to_the_goal(self) -> None:
        """Diagonal neighbours are none."""
        rows = ("#####", "#..##", "###.#", "#...#", "#####")
        own = {"maze": Maze(rows, origin=(0.0, 0.0)), "goal": (4.0, 2.0), "__module__": __name__}
        cut_off = r"goal=\(4.0, 2.0\): walls cut it off from the open cells at \(2, 6\), \(4, 6\)$"
        with pytest.raises(ValueError, match=cut_off):
            type("Split", (PointMaze,), own)("native")
