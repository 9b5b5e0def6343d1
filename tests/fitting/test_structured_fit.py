"""Which parts of a structured law are corrected, and that the others stay unchanged."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.coupling.bodies import join
from neuma_lib.fitting.frame_batches import first_contact, held_out_frames
from neuma_lib.fitting.material import ParticleLoss, PixelLoss, Stretch, train_material
from neuma_lib.fitting.structured_fit import (
    Alternative,
    Score,
    _select,
    first_informative_frame,
    from_frame,
    rival_bases,
    subsets,
    train_structured,
)
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import consecutive
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.splatting.observation import Observation
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, TRUTH, ball, block, camera, observe
from tests.support.training import MemoryCheckpoint

FRAMES = (0, 50, 60, 70, 80, 90, 100, 110)  # it touches the ground at about 50
V0 = torch.tensor([0.0, -1.5, 0.0], dtype=torch.float64)
SETTINGS = TrainingConfig(
    iterations=3, rank=None, lr_elastic=0.02, lr_plastic=0.02, warm_up=0, checkpoint_every=1
)
STRUCTURED = StructuredConfig(trial_iterations=2, blocks=2)
FLOWS = {
    "elasticity": {**TRUTH["elasticity"], "E": 6e4},
    "plasticity": {"name": "von_mises", "yield_stress": 1e6},  # beyond what the fall reaches
}


@pytest.fixture(scope="module")
def problem():
    body = ball()
    return body, PixelLoss(body, observe(body, V0, FRAMES))


def fit(problem, *specs, settings=SETTINGS, structured=STRUCTURED, **options):
    body, loss = problem
    laws = [structured_law(spec, MODEL.dt).double() for spec in specs]
    for law in laws:
        law.attach_adaptor(rank=settings.rank)
    options["alternatives"] = [Alternative(law, f"rival {k}") for k, law in enumerate(laws[1:], 1)]
    return train_structured(MODEL, laws[0], body.state(V0), loss, settings, structured, **options)


def deltas(law, part):
    return [p.detach() for p in law.parts[part].adaptor.parameters()]


@pytest.fixture(scope="module")
def too_stiff(problem):
    messages, states = [], []
    trained, choice = fit(problem, FLOWS, log=messages.append, progress=lambda *state: states.append(state))
    return trained, choice, messages, states


def test_only_the_part_that_improves_is_corrected(too_stiff):
    trained, choice, messages, states = too_stiff
    assert choice.parts == ("elastic",)
    assert set(choice.trials) == {"nothing", "elastic", "plastic", "elastic + plastic"}
    before, after = choice.trials["nothing"], choice.trials["elastic"]
    assert after.held_out_loss < 0.95 * before.held_out_loss
    assert choice.trials["plastic"] == before, "no state yields"
    assert any(bool(p.any()) for p in deltas(trained.law, "elasticity"))
    assert not any(bool(p.any()) for p in deltas(trained.law, "plasticity"))
    assert trained.best_loss < trained.history.loss[0] and len(messages) == 3
    done = [state[0] for state in states]
    assert done == sorted(done) and done[-1] == 5 and {state[1] for state in states} == {5}
    assert choice.held_out_frames == ((80, 110),) and choice.as_dict()["held_out_frames"] == [[80, 110]]


def test_held_out_frames_do_not_reach_the_trials(problem):
    """Other targets in the held-out frames change the held-out losses of the trials, and no bit of the fitted ones."""
    body, loss = problem
    spec = {"elasticity": FLOWS["elasticity"]}
    path = rollout(
        MODEL, structured_law(spec, MODEL.dt).double(), body.state(V0), steps=FRAMES[-1], frames=FRAMES
    )
    targets = path.x + torch.tensor([0.01, 0.0, 0.0], dtype=torch.float64)
    changed = targets.clone()
    changed[[FRAMES.index(80), FRAMES.index(110)]] += 0.05
    choices = [fit((body, ParticleLoss(FRAMES, x)), spec, log=lambda _: None)[1] for x in (targets, changed)]
    assert all(choice.held_out_frames == ((80, 110),) for choice in choices)
    for name, score in choices[0].trials.items():
        other = choices[1].trials[name]
        assert score.loss == other.loss and score.held_out_loss != other.held_out_loss


def test_the_last_training_goes_on_from_the_law_that_was_scored(problem, too_stiff):
    """Its first loss is that of the trial, over all frames from the contact on."""
    trained, choice, *_ = too_stiff
    body, _ = problem
    path = rollout(
        MODEL, structured_law(FLOWS, MODEL.dt).double(), body.state(V0), steps=FRAMES[-1], frames=FRAMES
    )
    contact = first_contact(MODEL, path.x, body.vol0)
    trial, out = choice.trials["elastic"], len(choice.held_out_frames[0])
    informative = len(FRAMES) - contact
    assert contact > 0
    mean = (trial.loss * (informative - out) + trial.held_out_loss * out) / informative
    assert trained.history.loss[0] == pytest.approx(mean, rel=1e-9)


def test_a_training_in_two_stretches_is_the_whole(problem):
    body, loss = problem
    slow = SETTINGS.model_copy(update={"lr_elastic": 1e-3, "warm_up": 2})  # every step lowers the loss

    def train(law, iterations, stretch=None):
        how = slow.model_copy(update={"iterations": iterations})
        return train_material(MODEL, law, body.state(V0), loss, how, stretch=stretch)

    laws = [structured_law({"elasticity": FLOWS["elasticity"]}, MODEL.dt).double() for _ in range(2)]
    for law in laws:
        law.attach_adaptor(rank=None)
    whole = train(laws[0], 5)
    first = train(laws[1], 2, Stretch(after=3))
    assert first.best_iteration == 2, "the law is that of the last step"
    second = train(laws[1], 3, Stretch(before=2, memory=first.memory))
    curve = first.history.weighted_loss + second.history.weighted_loss
    assert curve == pytest.approx(whole.history.weighted_loss, rel=1e-9)
    for once, again in zip(*(deltas(law, "elasticity") for law in laws), strict=True):
        assert torch.allclose(once, again, rtol=1e-9, atol=1e-15)


def test_a_correction_may_stiffen_beyond_the_limit_where_training_may_begin(problem):
    """Constants at the stiffness limit of the time step can also be corrected upwards."""
    body, loss = problem
    density, spec = float(body.state(V0).density.min()), {"elasticity": FLOWS["elasticity"]}
    number = MODEL.courant(structured_law(spec, MODEL.dt).double(), density)
    stiff = {"elasticity": {**FLOWS["elasticity"], "E": FLOWS["elasticity"]["E"] * (0.799 / number) ** 2}}
    law = structured_law(stiff, MODEL.dt).double()
    law.attach_adaptor(rank=None)
    with torch.no_grad():
        *_, last = law.elasticity.adaptor.parameters()
        last[:2, -1] = 0.1  # both moduli by 10 %
    assert MODEL.courant(law, density) > 0.8
    how = SETTINGS.model_copy(update={"iterations": 1})
    with refused("dt"):
        train_material(MODEL, law, body.state(V0), loss, how)
    assert train_material(MODEL, law, body.state(V0), loss, how, stretch=Stretch(before=2)).stable


@pytest.mark.parametrize("viscosity", [20.0, 60.0])
def test_the_first_step_on_a_fluid_that_is_too_viscous_lowers_the_loss(viscosity):
    """It also adds a yield stress and changes the volume response, which must not cancel the improvement."""
    body, elasticity = ball(), {"name": "hencky", "E": 5e4, "nu": 0.3}

    def spec(factor):
        flow = {"name": "viscous_flow", "viscosity": factor * viscosity}
        return {"elasticity": elasticity, "plasticity": flow}

    law = structured_law(spec(1.08), MODEL.dt).double()
    law.attach_adaptor(rank=None)
    how = TrainingConfig(iterations=2, rank=None, lr_elastic=0.02, lr_plastic=0.04)
    loss = PixelLoss(body, observe(body, V0, FRAMES, spec(1.0)))
    trained = train_material(MODEL, law, body.state(V0), loss, how, stretch=Stretch(after=24))
    first, second = trained.history.loss
    assert second < first and not trained.history.recoveries


def test_a_law_that_nothing_improves_is_unchanged(problem):
    """The video is that of the law itself."""
    trained, choice = fit(problem, TRUTH, log=lambda _: None)
    assert choice.parts == () and set(choice.trials) == {"nothing", "elastic"}
    assert not any(bool(p.any()) for p in deltas(trained.law, "elasticity"))
    assert trained.stable and len(trained.history.loss) == 1 and trained.summary()


@pytest.mark.parametrize("saves", [1, 2, 4])
def test_an_interrupted_run_resumes_to_the_same_bits(problem, too_stiff, saves):
    """In the trial, at its end, in the last training."""
    keep = MemoryCheckpoint(fail_after=saves)
    with pytest.raises(KeyboardInterrupt):
        fit(problem, FLOWS, log=lambda _: None, checkpoint=keep)
    before = len(keep.states)
    trained, choice = fit(problem, FLOWS, log=lambda _: None, checkpoint=keep)
    assert choice == too_stiff[1] and len(keep.states) == 5 and before == saves
    for part in ("elasticity", "plasticity"):
        for again, once in zip(deltas(trained.law, part), deltas(too_stiff[0].law, part), strict=True):
            assert torch.equal(again, once)


def test_each_part_has_to_gain_the_margin():
    def chosen(elastic, plastic, both, margin=0.1):
        losses = {"nothing": 1.0, "elastic": elastic, "plastic": plastic, "elastic + plastic": both}
        trials = {name: Score(0.0, loss) for name, loss in losses.items()}
        candidates = [(0, parts) for parts in subsets(("elastic", "plastic"))]
        base, parts = _select(candidates, [Alternative(None, "", rival=False)], trials, margin)
        assert base == 0
        return parts

    assert chosen(0.91, 0.95, 0.82) == ()
    assert chosen(0.89, 0.95, 0.82) == ("elastic",)
    assert chosen(0.89, 0.85, 0.77) == ("plastic",)
    assert chosen(0.89, 0.85, 0.76) == ("elastic", "plastic")
    assert chosen(0.89, 0.85, float("inf")) == ("plastic",)
    assert chosen(1.0, 1.0, 1.0, margin=0.0) == ()


CLOSER = {**FLOWS, "elasticity": {**TRUTH["elasticity"], "E": 3.5e4}}


def test_a_rival_whose_correction_does_better_takes_the_place_of_the_law(problem):
    """Both have a yield stress that is not reached. One is nearer to the stiffness of the video."""
    done = []
    trained, choice = fit(
        problem, FLOWS, CLOSER, log=lambda _: None, progress=lambda *state: done.append(state[:2])
    )
    assert choice.base == 1 == choice.as_dict()["base"] and choice.parts == ("elastic",)
    assert "rival 1: elastic" in choice.summary() and "rival 1: elastic + plastic" in choice.trials
    assert trained.law.specification()["elasticity"]["E"] == 3.5e4
    assert done[-1] == (7, 7) and done == sorted(done)
    # as if it had been the law from the beginning
    alone, of_it = fit(problem, CLOSER, log=lambda _: None)
    assert choice.trials["rival 1: elastic"] == of_it.trials["elastic"]
    assert all(map(torch.equal, deltas(trained.law, "elasticity"), deltas(alone.law, "elasticity")))


def test_a_rival_that_does_worse_changes_nothing(problem):
    trained, choice = fit(problem, CLOSER, FLOWS, log=lambda _: None)
    alone, _ = fit(problem, CLOSER, log=lambda _: None)
    assert choice.base == 0 and trained.best_loss == alone.best_loss
    assert all(map(torch.equal, deltas(trained.law, "elasticity"), deltas(alone.law, "elasticity")))


@pytest.mark.parametrize("saves", [2, 3, 5, 6])
def test_an_interrupted_run_with_a_rival_resumes(problem, saves):
    never, keep = MemoryCheckpoint(), MemoryCheckpoint(fail_after=saves)
    whole, choice = fit(problem, FLOWS, CLOSER, log=lambda _: None, checkpoint=never)
    with pytest.raises(KeyboardInterrupt):
        fit(problem, FLOWS, CLOSER, log=lambda _: None, checkpoint=keep)
    trained, again = fit(problem, FLOWS, CLOSER, log=lambda _: None, checkpoint=keep)
    assert again == choice and len(keep.states) == len(never.states) > saves
    assert all(map(torch.equal, deltas(trained.law, "elasticity"), deltas(whole.law, "elasticity")))


def test_a_rival_has_to_gain_the_margin_too():
    trials = {"nothing": Score(0.0, 1.0), "elastic": Score(0.0, 0.8), "rival 1: elastic": Score(0.0, 0.73)}
    candidates = [(0, ("elastic",)), (1, ("elastic",))]
    bases = [Alternative(None, "", rival=False), Alternative(None, "rival 1")]
    assert _select(candidates, bases, trials, 0.1) == (0, ("elastic",))
    trials["rival 1: elastic"] = Score(0.0, 0.71)
    assert _select(candidates, bases, trials, 0.1) == (1, ("elastic",))


def test_rivals_are_ties_with_other_return_maps_the_best_first():
    def law(flow):
        return {"elasticity": {"name": "hencky"}, "plasticity": {"name": flow}}

    flows = {"sand": "drucker_prager", "clay": "von_mises", "hencky": "identity", "bingham": "viscous_flow"}
    scores = {"sand": -7.2, "clay": -7.0, "hencky": -7.1, "bingham": -7.3, "fluid": -7.4}
    families = {name: {"law": law(flow), "score": scores[name]} for name, flow in flows.items()}
    families["fluid"] = {"law": law("viscous_flow"), "score": scores["fluid"]}
    results = {"law": law("von_mises"), "families": families, "ties": ["clay", "hencky", "bingham", "fluid"]}
    assert rival_bases(results, 3) == [law("viscous_flow"), law("identity")]
    assert rival_bases(results, 1) == [law("viscous_flow")]
    assert rival_bases(results, 0) == [] == rival_bases({**results, "ties": []}, 1)


def test_some_frames_of_a_loss_are_those_of_the_loss(problem):
    body, loss = problem
    law, keep = structured_law(FLOWS, MODEL.dt).double(), [0, 1, 4, 6]
    path = rollout(MODEL, law, body.state(V0), steps=FRAMES[-1], frames=FRAMES)
    targets = ParticleLoss(FRAMES, path.x.flip(0))
    for whole in (loss, targets):
        part = whole.select(keep)
        assert part.frames == tuple(FRAMES[k] for k in keep) and part.total == whole.total
        assert torch.equal(part(path.at(part.frames)), whole(path)[keep])


@pytest.mark.parametrize("contact", [0, 3])
@pytest.mark.parametrize("blocks", [1, 2, 4, 50])
@pytest.mark.parametrize("count", [4, 7, 33, 400])
@pytest.mark.parametrize("share", [0.01, 0.25, 0.9])
def test_held_out_frames_end_each_block_after_the_contact(blocks, count, share, contact):
    """They are about the given share, include the last frame but not the first, and leave some frames in each block."""
    held_out = held_out_frames(count, share, blocks, contact)
    first = contact if contact < count - 1 else 0
    parts = min(blocks, (count - first) // 2)
    assert held_out == sorted(set(held_out)) and held_out[-1] == count - 1 and held_out[0] > first
    assert abs(len(held_out) - share * (count - first)) <= parts
    edges = [first + round(k * (count - first) / parts) for k in range(parts + 1)]
    for start, end in pairwise(edges):
        assert end - 1 in held_out and start not in held_out


@pytest.mark.parametrize("first", [0, 1, 3, 5])
def test_a_video_from_a_frame_on_is_the_rest_of_the_whole(first):
    """Of a spinning ball, which is strained before contact, from before and within contact, where particles stick."""
    body, frames = ball(), (0, 20, 40, 50, 60, 80)
    start = body.state(V0, torch.tensor([2.0, -3.0, 4.0], dtype=torch.float64))
    law = structured_law(FLOWS, MODEL.dt).double()
    path = rollout(MODEL, law, start, steps=frames[-1], frames=frames, total=True)
    assert first_contact(MODEL, path.x, body.vol0) == 3 and (path.F[2] - torch.eye(3)).abs().max() > 1e-3
    assert path.stuck is not None and path.stuck[4].any() and not path.stuck[2].any()
    whole = PixelLoss(body, observe(body, V0, frames))
    later, rest = from_frame(start, whole, path, first)
    before = frames[first - 1] if first else 0
    assert rest.frames == tuple(step - before for step in frames[first:])
    again = rollout(MODEL, law, later, steps=rest.frames[-1], frames=rest.frames)
    assert torch.allclose(again.x, path.x[first:], rtol=0, atol=1e-12)
    assert torch.allclose(rest(again), whole(path)[first:], rtol=1e-9)
    targets = ParticleLoss(frames, path.x.flip(0))
    _, rest = from_frame(start, targets, path, first)
    assert torch.allclose(rest(again), targets(path)[first:], rtol=1e-9)


def test_obstacles_move_in_a_fit_as_in_the_video():
    """A box rises into the falling ball. The true law then reproduces the frames that inform on the law."""
    box = Collider("box", (0.4, 0.02, 0.4), centre=(0.5, -0.1, 0.5), velocity=(0.0, 2.0, 0.0))
    model = replace(MODEL, colliders=(Collider("plane"), box))
    body, frames = ball(), (0, 20, 40, 60, 70, 80, 90, 100)
    loss = PixelLoss(body, observe(body, V0, frames, model=model))
    law = structured_law(TRUTH, MODEL.dt).double()
    law.attach_adaptor(rank=None)
    _, choice = train_structured(model, law, body.state(V0), loss, SETTINGS, STRUCTURED, log=lambda _: None)
    assert model.changes and choice.trials["nothing"].held_out_loss < 1e-12


def test_frames_after_the_contact_inform_on_the_law_unless_too_few_follow():
    assert [first_informative_frame(10, contact) for contact in (0, 1, 6, 7, 10)] == [0, 1, 6, 0, 0]


def test_choices_of_parts():
    assert subsets(("elastic",)) == [("elastic",)]
    assert subsets(("elastic", "plastic")) == [("elastic",), ("plastic",), ("elastic", "plastic")]


def test_the_first_contact_is_that_of_any_particle():
    x = torch.full((5, 2, 3), 0.5)
    assert first_contact(MODEL, x, torch.full((2,), 1e-6)) == 5
    x[2:, 1, 1] = 0.006  # the radius of a volume of 1 cm^3 is 5 mm
    assert first_contact(MODEL, x, torch.full((2,), 1e-6)) == 5
    x[3:, 1, 1] = 0.004
    assert first_contact(MODEL, x, torch.full((2,), 1e-6)) == 3


def test_too_few_frames(problem):
    body, loss = problem
    with refused("frames"):
        fit((body, loss.select([0, 1, 2])), TRUTH)


BLOCK = {"elasticity": {"name": "hencky", "E": 1e5, "nu": 0.3}}


@pytest.fixture(scope="module")
def next_to_a_block():
    """A ball that falls on a sliding block, whose law is known: model, start, loss, and the laws from the ball's."""
    bodies, counts = [block(), ball(height=0.33)], [300, 300]
    velocities = [(0.8, -0.4, 0.0), (0.0, -1.5, 0.0)]
    start = State.joined([body.state(v) for body, v in zip(bodies, velocities, strict=True)], separate=True)
    model, frames = replace(MODEL, pairs=(Pair(0, 1, 0.3),)), tuple(range(0, 121, 12))
    known = analytic_law(BLOCK, model.dt)
    true, cameras = analytic_law(TRUTH, model.dt), camera()

    def surrounded(law):
        return consecutive([known, law], counts)

    with torch.no_grad():
        path = rollout(model, surrounded(true), start, steps=frames[-1], frames=frames)
        images = join(bodies).particle_gs(cameras)(path.x, path.F)
    return model, start, PixelLoss(join(bodies), Observation(frames, images, cameras)), surrounded


@pytest.mark.parametrize("order", [("ball", "block"), ("block", "ball")])
def test_the_body_whose_law_is_wrong_is_corrected(next_to_a_block, order):
    """The ball touches the block only, so that its frames before the block touches the floor are not left out."""
    model, start, loss, around = next_to_a_block

    def with_ball(law):
        return consecutive([law, analytic_law(FLOWS, model.dt).double()], [300, 300])

    specs, others = {"ball": FLOWS, "block": BLOCK}, {"ball": around, "block": with_ball}
    bases = [
        Alternative(structured_law(specs[name], model.dt).double(), name, others[name], False)
        for name in order
    ]
    for base in bases:
        base.law.attach_adaptor(rank=None)
    first, other = bases
    options = {"surrounded": first.surrounded, "name": first.name, "log": lambda _: None}
    trained, choice = train_structured(
        model, first.law, start, loss, SETTINGS, STRUCTURED, alternatives=[other], **options
    )
    trials = {name: score.held_out_loss for name, score in choice.trials.items()}
    assert (choice.name, choice.parts) == ("ball", ("elastic",)) and choice.base == order.index("ball")
    assert choice.summary().startswith("corrected: ball: elastic;")
    assert (
        trials["ball: elastic"] < 0.9 * trials["nothing"]
        and trials["block: elastic"] > trials["ball: elastic"]
    )
    assert trained.best_loss < 0.9 * trained.history.loss[0]
    assert any(bool(p.any()) for p in deltas(trained.law, "elasticity"))
    assert len(choice.held_out_frames[0]) == 2 and choice.held_out_frames[0][-1] == 120


def test_slope_of_a_law_next_to_another_is_that_of_differences(next_to_a_block):
    model, start, loss, surrounded = next_to_a_block
    law = structured_law(FLOWS, MODEL.dt).double()
    law.attach_adaptor(rank=None)
    weights = [p for p in law.parts["elasticity"].adaptor.parameters()]
    generator = torch.Generator().manual_seed(1)
    along = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in weights]

    def value(step):
        with torch.no_grad():
            for p, direction in zip(weights, along, strict=True):
                p.copy_(step * direction)
        path = rollout(model, surrounded(law), start, steps=loss.steps[-1], frames=loss.steps)
        return loss(path).mean()

    value(0.05).backward()
    slope = sum(float((p.grad * direction).sum()) for p, direction in zip(weights, along, strict=True))
    with torch.no_grad():
        difference = float(value(0.05 + 1e-5) - value(0.05 - 1e-5)) / 2e-5
    assert abs(difference) > 1e-5 and slope == pytest.approx(difference, rel=1e-3)
