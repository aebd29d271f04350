"""Pairs, pushes, safe steps and crossings of outfits, each beside its twin in float64; crossings beside ipctk too."""

import ipctk
import numpy as np
import pytest
import torch
from support.layers import packed, shaken, tubes
from support.poison import poison_outputs

from tests.reference import cloth as reference
from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.cloth.crossings import crossings
from warpgarment.kernels.cloth.newly import newly_crossing
from warpgarment.kernels.cloth.order import LEAST, ROUNDS, set_free
from warpgarment.kernels.cloth.pairs import MARGIN, FacePairs
from warpgarment.kernels.cloth.parting import parted
from warpgarment.kernels.cloth.steps import SHRINK, safe_steps

THICKNESS = 0.002


class Case:
    """Two outfits at one place, of two layers and one, that move at random between a start and an end."""

    def __init__(self, seed: int, at_start: float = 0.001, at_end: float = 0.015, itself: bool = True) -> None:
        vertices, self.outfits = packed(tubes(2), tubes(1), itself=itself)
        o = self.outfits
        self.start, self.end = shaken(vertices, at_start, seed), shaken(vertices, at_end, seed + 100)
        self.moving = torch.ones(3, dtype=torch.bool)
        self.faces, self.garment, self.outfit, self.rank = (
            tensor.numpy() for tensor in (o.faces, o.garment, o.outfit, o.rank)
        )
        self.of_vertex = np.full(len(vertices), -1, np.int32)
        self.of_vertex[self.faces] = self.outfit[:, None]

    def tensors(self) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.from_numpy(self.start), torch.from_numpy(self.end)

    def contacts(self, rounds: int = 3, partners: int = 128) -> Contacts:
        start, end = self.tensors()
        made = Contacts(
            FacePairs(self.outfits, start, partners=partners), len(start), thickness=THICKNESS, rounds=rounds
        )
        made.pairs.find(start, end, self.moving)
        made.find(start, end)
        return made

    def twin_pairs(self, itself: bool = True) -> set[tuple[int, int]]:
        return reference.pairs(
            self.start, self.end, self.faces, self.garment, self.outfit, itself, self.moving.numpy(), MARGIN
        )

    def of_twin(self, contacts: Contacts) -> tuple[set[tuple[int, int]], np.ndarray]:
        """The pairs that were found, and the kernel's normals in their order."""
        found = listed(contacts.pairs)
        order = sorted(found)
        return set(order), np.array([contacts.normal[m, found[m, o]].numpy() for m, o in order], np.float64)


def listed(pairs: FacePairs) -> dict[tuple[int, int], int]:
    """The pairs, with the place of each in the row of its first face."""
    return {
        (m, int(pairs.partners[m, k])): k
        for m, count in enumerate(pairs.count.tolist())
        for k in range(min(count, pairs.partners.shape[1]))
    }


def ipc(faces: np.ndarray, count: int) -> ipctk.CollisionMesh:
    edges = ipctk.edges(faces)
    return ipctk.CollisionMesh(np.zeros((count, 3)), edges, faces)


@pytest.mark.parametrize("itself", [True, False])
def test_pairs_are_those_of_brute_force(monkeypatch, itself):
    """A pair that is not found can cross unseen; outfits at one place would see each other. Exactly the same pairs."""
    poison_outputs(monkeypatch)
    case = Case(0, itself=itself)
    found = case.contacts().pairs
    assert set(listed(found)) == case.twin_pairs(itself)
    assert int(found.count.sum()) == len(listed(found)) > 500
    case.moving[0] = False
    found.find(*case.tensors(), case.moving)
    assert set(listed(found)) == case.twin_pairs(itself)


def test_pairs_beyond_the_room_are_counted(monkeypatch):
    """Crossings of pairs for which there was no room would pass for none."""
    poison_outputs(monkeypatch)
    case = Case(1)
    few = case.contacts(partners=4)
    assert int(few.pairs.count.sum()) == len(case.twin_pairs())
    found = crossings(few.model, len(case.faces), few.normal, torch.from_numpy(case.end), 3)
    assert int(found.unseen.sum()) == len(case.twin_pairs()) - len(listed(few.pairs)) > 0


@pytest.mark.parametrize("seed", [0, 1])
def test_directions_and_pushes_are_those_of_the_twin(monkeypatch, seed):
    """Layers would be pushed the wrong way or too far. 20 um: float32, sums in units of 0.24 um, three rounds."""
    poison_outputs(monkeypatch)
    case = Case(seed)
    contacts = case.contacts()
    found, normal = case.of_twin(contacts)
    start, end = case.start.astype(float), case.end.astype(float)
    m, o = np.array(sorted(found)).T
    assert (reference.gap(start[case.faces[m]], start[case.faces[o]], normal) > 0).all()
    pushed = contacts.pushed(*case.tensors()).numpy()
    twin = reference.pushed(start, end, case.faces, case.garment, case.rank, found, THICKNESS, 3, MARGIN)
    assert np.abs(twin - end).max() > 0.003
    assert np.abs(pushed - twin).max() < 2e-5


@pytest.mark.parametrize("seed", [2, 3])
def test_parted_pairs_are_those_of_the_twin(monkeypatch, seed):
    """Pairs would be parted along a wrong direction or too far. 20 um, as for pushes. Less than 2 % of what was not
    safe is left after 40 rounds, and rounds that nobody needs change no bit."""
    poison_outputs(monkeypatch)
    case = Case(seed, at_end=0.008)
    contacts = case.contacts()
    found, normal = case.of_twin(contacts)
    start, end = case.start.astype(float), case.end.astype(float)
    twin = reference.parted(
        start, end, end, case.faces, case.garment, case.rank, found, normal, 2, contacts.pairs.margin
    )
    moved = parted(contacts, *case.tensors(), case.tensors()[1], 2, rounds=2).numpy()
    assert np.abs(twin - end).max() > 0.003
    assert np.abs(moved - twin).max() < 2e-5
    long = parted(contacts, *case.tensors(), case.tensors()[1], 2, rounds=40)
    pair = np.array(sorted(found)).T
    unsafe = [
        int((normal.any(1) & ~reference.safe(start, x, case.faces, *pair, normal)).sum())
        for x in (end, long.numpy().astype(float))
    ]
    assert unsafe[1] < 0.02 * unsafe[0]
    assert torch.equal(parted(contacts, *case.tensors(), case.tensors()[1], 2, rounds=40, early_exit=True), long)


@pytest.mark.parametrize("seed", range(3))
def test_steps_are_those_of_the_twin(monkeypatch, seed):
    """Cloth would stop too late, and cross, or too early. 2 um; shares are equal unless a gap is at its limit."""
    poison_outputs(monkeypatch)
    case = Case(seed, at_end=0.008)
    contacts = case.contacts()
    found, normal = case.of_twin(contacts)
    steps = safe_steps(contacts, *case.tensors(), torch.from_numpy(case.of_vertex), 2)
    twin, held = reference.safe_steps(
        case.start.astype(float), case.end.astype(float), case.faces, case.outfit, found, normal, SHRINK
    )
    assert (np.abs(twin - case.end).max(1) > 1e-3).mean() > 0.1
    assert np.abs(steps.positions.numpy() - twin).max() < 2e-6
    assert set(np.flatnonzero(steps.held.numpy())) == held


@pytest.mark.parametrize(("size", "pushes"), [(0.005, 0), (0.01, 3), (0.03, 3)])
def test_what_was_free_stays_free(monkeypatch, size, pushes):
    """The promise of the stage: from a start without crossings nothing crosses, on the whole way and at its end. Judged
    by ipctk's intersections and continuous detection, one outfit at a time; exact."""
    poison_outputs(monkeypatch)
    for seed in range(4):
        case = Case(seed, at_end=size)
        contacts = case.contacts(rounds=pushes, partners=300)
        start, end = case.tensors()
        wanted = contacts.pushed(start, end)
        reached = safe_steps(contacts, start, wanted, torch.from_numpy(case.of_vertex), 2).positions.numpy()
        for number in (0, 1):
            own = case.of_vertex == number  # others would be points in the air
            mesh = ipc(case.faces[case.outfit == number] - own.argmax(), own.sum())
            before, after = case.start[own].astype(float), reached[own].astype(float)
            assert not ipctk.has_intersections(mesh, before)
            assert not ipctk.has_intersections(mesh, after)
            assert ipctk.is_step_collision_free(mesh, before, after)
        assert np.abs(reached - case.start).max() > 1e-4
        crossing = crossings(contacts.model, len(case.faces), contacts.normal, torch.from_numpy(reached), 3)
        assert not any(int(part.sum()) for part in crossing)


def test_common_motion_is_not_held():
    """Layers that lie on each other would hang back whenever they swing together. They are 0.3 mm apart, move by 10 cm
    and widen by a tenth; every vertex arrives."""
    vertices, outfits = packed(tubes(2, gap=0.0003, turn=0.0, around=24))
    start = torch.from_numpy(vertices)
    end = torch.from_numpy((1.1 * vertices + [0.1, 0.0, 0.05]).astype(np.float32))
    contacts = Contacts(FacePairs(outfits, start, partners=400), len(start), thickness=1e-4, rounds=0)
    contacts.pairs.find(start, end, torch.ones(2, dtype=torch.bool))
    assert int(contacts.pairs.count.max()) <= 400
    contacts.find(start, end)
    steps = safe_steps(contacts, start, end, torch.zeros(len(start), dtype=torch.int32), 1)
    assert torch.equal(steps.positions, end)


@pytest.mark.parametrize(("size", "seed"), [(0.0, 0), (0.004, 1), (0.012, 2), (0.03, 3)])
def test_crossings_are_those_of_brute_force_and_ipctk(monkeypatch, size, seed):
    """A crossing would be called free. The number is that of edges against faces in float64; whether there is any, that
    of ipctk. The direction of another frame as a guess changes nothing."""
    poison_outputs(monkeypatch)
    case = Case(seed, at_start=size)
    case.end = case.start
    contacts = case.contacts(partners=300)
    twin = reference.crossings(case.start.astype(float), case.faces, case.garment, case.outfit, 3)
    for normal in (torch.zeros((0, 0, 3)), contacts.normal):
        found = crossings(contacts.model, len(case.faces), normal, torch.from_numpy(case.start), 3)
        assert torch.stack(found[:2], dim=1).tolist() == twin.tolist()
    for number in (0, 1):
        own = case.of_vertex == number
        mesh = ipc(case.faces[case.outfit == number] - own.argmax(), own.sum())
        crosses = bool(twin[np.unique(case.garment[case.outfit == number])].sum())
        assert ipctk.has_intersections(mesh, case.start[own].astype(float)) == crosses
    assert (twin.sum() > 20) == (size > 0.01)


def test_only_new_crossings_call_for_another_start(monkeypatch):
    """An outfit that crosses would never be carried by the body again, or one that begins to cross be accepted."""
    poison_outputs(monkeypatch)
    case = Case(4, at_start=0.02)  # the two layers cross
    contacts = case.contacts(partners=300)
    free = torch.from_numpy(Case(4, at_start=0.0).start)
    assert newly_crossing(contacts, free, 2).tolist() == [True, False]
    assert newly_crossing(contacts, torch.from_numpy(case.start), 2).tolist() == [False, False]
    assert newly_crossing(Case(0).contacts(), free, 2).tolist() == [False, False]


def test_pairs_around_crossings_are_set_free(monkeypatch):
    """A crossing would be kept by the faces around it, or what is far from it lose its side. The twin sets the same
    pairs free; without a crossing none. The outer tube is pushed into the inner one from one side."""
    poison_outputs(monkeypatch)
    case = Case(5, at_start=0.0, itself=False)
    outer = np.flatnonzero((case.of_vertex == 0) & (np.arange(len(case.start)) >= case.faces[case.garment == 1].min()))
    free = case.contacts(partners=300)
    before = free.normal.clone()
    set_free(free, case.tensors()[0], 2)
    kept = torch.arange(300)[None] < free.pairs.count[:, None]
    assert torch.equal(free.normal[kept], before[kept])
    near = np.linalg.norm(case.start[outer] - case.start[outer].mean(0) - [0.115, 0, 0], axis=1) < 0.1
    case.start[outer[near]] -= np.float32([0.03, 0, 0])
    contacts = case.contacts(partners=300)
    found, normal = case.of_twin(contacts)
    twin = reference.freed(case.start.astype(float), case.faces, case.garment, case.rank, found, normal, ROUNDS, LEAST)
    for early_exit in (False, True):
        set_free(contacts, case.tensors()[0], 2, early_exit=early_exit)
        freed = case.of_twin(contacts)[1]
        assert np.array_equal(freed.any(1), twin.any(1))
    assert 10 < (normal.any(1) & ~freed.any(1)).sum() < 0.5 * len(normal)
