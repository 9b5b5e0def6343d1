"""Identify the material shown in a video.

Fits the constants of every candidate family and selects the family with the lowest held-out error. The fit is
Levenberg-Marquardt through rollout and renderer, with a Jacobian of a few rollouts. It proceeds from coarse to fine
levels of an image pyramid, because the basin of convergence of sharp images is about a pixel. Constants are unbounded
logarithms or logits. A family is initialised from the best of its default guess, the scene's prior and the fits of
simpler families. A family with the constants of another, or with a limit that flows, follows that one at the level
before the last. Families whose loss exceeds ``prune_factor`` times the best with the same return map are dropped.

Rollouts on the finer grid take most of the time, then those of differences. Derivatives are therefore passed on to the
next level, family or grid, and updated by the steps (`secant_update`). They are differentiated again after a step that
fails, and for the final fits. Steps that predict less than the noise of the images by unsteady contacts are not tried.

The initial motion is estimated from the frames before contact, with an uncertainty that would bias the constants. The
last level therefore also fits velocity and spin with a prior, and a constant shift and enlargement of the rendered
body, which would otherwise appear as motion (`video_residuals`).

Families are fitted to the first frames and evaluated on the last ones, so that additional constants have no advantage.
Frames before the first contact do not depend on the law and are always fitted. A family is dropped if its images equal
those of a family that it contains, i.e. if its additional constants are at their limits. Uncertainty is estimated by a
block jackknife over the image and reported for combinations of constants, because some are not identifiable alone:
purely plastic flow determines the yield stress but not the stiffness. It is increased on plateaus of the loss, and by
the disagreement of the last frames or of tied families.

On a coarse grid, most of the loss is discretisation error, which may hide the family. With a refined body, families of
similar scores are therefore fitted again and selected on a finer grid. The selected family is fitted on both grids. The
constants of the material follow by extrapolation to a cell size of zero (`FamilyFit.extrapolated`). Those of the coarse
grid predict best on that grid. With a ``refinement`` of 1, the refined body is on the same grid and alone is fitted.

The Coulomb coefficient of the body and all its obstacles may be a constant of every family. Where the images also admit
that the body sticks, the result is a lower bound of the coefficient.

Several videos of one material share the constants and have one initial motion each. Their weights are equal if a
coarser grid changes their images as much as those of the first video, else lower (`video_residuals.weigh`). Each family
is first fitted to the first video alone, because the loss of videos with oscillations has a narrow valley.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from neuma_lib.config.identify import FRICTION_NEEDS, IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.families import FRICTION, Family
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.frame_batches import check_contact
from neuma_lib.fitting.identified import FamilyFit, Identified
from neuma_lib.fitting.video_residuals import NUISANCES, Candidate, VideoResiduals, weigh
from neuma_lib.mechanics.combinations import Values, constants_of
from neuma_lib.sim.model import MPM, model_of_each
from neuma_lib.splatting.observation import Observation, joint_frames, several

_CONTENDERS = 3  # families that are compared on the finer grid
_CLEAR = 2.0  # least logarithm of the ratio of a field relative to its change with other particles
_OTHER_LIMITS = (-2, -1, 1, 2)  # powers of 4 of the limits of a flow that restarts near another family


def identify(
    model: MPM | Sequence[MPM],
    motion: InitialMotion,
    body: Reconstruction,
    observation: Observation | Sequence[Observation],
    settings: IdentifyConfig,
    published: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    refined: Sequence[Reconstruction] = (),
    other_videos: Sequence[tuple[InitialMotion, Reconstruction, Observation | Sequence[Observation]]] = (),
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = lambda text: None,
) -> Identified:
    """Identify the family and the constants of the material shown in a video.

    Args:
        model: simulator constants, or those of each video if colliders or clamps differ.
        motion: estimate of the initial motion from the frames before contact.
        body: reconstructed particles and Gaussians.
        observation: the video, or several of the same motion by cameras of different times, sizes or exposures, with
            the views of the settings.
        settings: candidates and hyper-parameters.
        published: specification of the law of the scene's prior, an additional start, or None if unknown.
        refined: for each video, the body with more particles for a finer grid, or for the same one if ``refinement``
            is 1. Without them, constants of the material are not estimated.
        other_videos: initial motion, body and observation of other videos of the same material.
        progress: called with (finished fits, number of fits, mean squared residual).
        log: receives a line for every family.

    Raises:
        InputError: fewer than four frames, none of them after a contact, no family, or one with unknown parts, or
            friction to be fitted without contact of particles.
        NonFiniteError: every family diverges from every start.
    """
    given = [(motion, body, observation), *other_videos]
    if (count := min(len(joint_frames(several(video))) for *_, video in given)) < 4:
        problem = f"{count} frames of the training view must be at least 4, to fit and to evaluate"
        raise InputError("frames", problem)
    if not settings.families:
        problem = "it has no candidates"
        raise InputError("identify.families", problem, "Add at least one elasticity with E and nu")
    models = model_of_each(model, len(given))
    check_contact(models, ((one.of_body(each), joint_frames(several(video))) for one, each, video in given))
    fits_friction = settings.contact_friction == "fitted"
    if fits_friction and any(each.contact != "particles" for each in models):
        raise InputError("identify.contact_friction", *FRICTION_NEEDS)
    families = [Family(name, law.plain(), fits_friction) for name, law in settings.families.items()]
    families.sort(key=lambda family: len(family.constants))  # simpler families provide starts of the others
    resampled = refined or [None] * len(given)
    videos = [
        VideoResiduals(each, *one, settings, own)
        for each, one, own in zip(models, given, resampled, strict=True)
    ]
    for video in videos:
        video.hold_out(families[0], settings.held_out)
    published_values = constants_of(published) if published else {}
    running: list[FamilyRun] = []
    rounds = len(settings.pyramid)
    other_grid = bool(refined) and settings.refinement > 1
    early: list[Family] = []
    late: list[Family] = []
    for family in families:
        is_late = rounds > 1 and any(_is_near(family, other) for other in early)
        (late if is_late else early).append(family)
    guesses = {family: [family.with_guesses(values) for values in ({}, published_values)] for family in early}
    if len(videos) > 1:
        alone = [_fit_to_first(family, videos[0], guesses[family], settings) for family in early]
        lowest = min(alone, key=lambda run: run.loss)
        if lowest.alive:
            at = Candidate(
                lowest.family.law_spec(lowest.values), np.zeros(NUISANCES), lowest.values.get(FRICTION)
            )
            weigh(videos, at, lowest.loss)
        for run in alone:
            guesses[run.family] += [run.values] if run.alive else []
    for family in early:
        running.append(_first_fit(family, videos, running, guesses[family], settings))
    for run, best in _better_later(running):
        start = run.family.with_guesses({**run.values, **best.values})
        run.restart_from([start, *run.family.with_other_limits(start, _OTHER_LIMITS)])
    total = rounds * len(families)
    for level in range(1, rounds):
        _prune(running, settings, keep_redundant=other_grid)
        following = sorted((run for run in running if run.alive), key=lambda run: run.fit.cost)
        if following and level == rounds - 1:
            following[0].differentiate()
        for done, run in enumerate(following):
            run.refine(level, rough=other_grid)
            if progress:
                progress(level * len(families) + done + 1, total, run.loss)
        if level >= rounds - 2:
            running += [
                _late_fit(family, videos, running, settings, level, rough=other_grid) for family in late
            ]
            late = []
    fits = {run.family.name: run.score() for run in running}
    _log_fits(fits.values(), "", log)
    compared, fine = fits, {}
    if other_grid or refined and any(family.field for family in families):
        fine = _on_finer_grid(running, fits, videos, settings)
    if any(each.alive for each in fine.values()):
        compared = {name: each.score() for name, each in fine.items() if each.alive}
        _log_fits(compared.values(), " on the finer grid", log)
    selected, ties = select_family(list(compared.values()), settings)
    name = selected.family.name
    run = next(run for run in running if run.family is selected.family)
    again = fine.get(name)
    starts, first = [run.values], rounds - 1
    # If the first frames misled, restart at the coarsest level.
    if selected.held_out > settings.prune_factor * selected.loss:
        starts = [run.values, *(run.family.with_guesses(values) for values in ({}, published_values))]
        first = 0
    counts = [len(video.frames) for video in videos]
    final = FamilyRun(run.family, videos, counts, settings)
    final.begin(starts, first, run.deviations)
    for level in range(first + 1, rounds if final.alive else 0):
        final.refine(level)
    lowest = final.lowest_friction() if final.alive else None
    if lowest is not None:
        for video in videos:
            video.set_friction(math.inf)
        sticking, start = Family(run.family.name, run.family.spec), (final.values, final.deviations)
        final = FamilyRun(sticking, videos, counts, settings)
        final.begin(start[:1], rounds - 1, start[1])
    # Plateaus are properties of the material that both grids show.
    plateaus = final.covariance_of_plateaus() if final.alive else np.zeros(())
    best, material = final.score(), None
    between = best.disagreement(fits[name], [fits[tie] for tie in ties])
    if refined and final.alive and (again.alive if again else not other_grid):
        whole = FamilyRun(final.family, videos, counts, settings, fine=True)
        starts = [again.values] if again else []
        starts += [final.values] if first == 0 or not again else []
        starts = [{key: each[key] for key in final.values} for each in starts]
        whole.begin(starts, rounds - 1, final.deviations, like=[final])
        if whole.alive:
            material = whole.score()
            own = material.disagreement(selected, [compared[tie] for tie in ties]) if again else between
            material.covariance = material.covariance + plateaus + own
    if best.covariance is not None:
        best.covariance = best.covariance + plateaus + between
    best.lowest_friction = lowest
    if material is not None:
        material = material.extrapolated(best, settings.refinement, len(refined[0].x0) / len(body.x0))
        material.lowest_friction = lowest
    elif refined:
        log(
            f"{name}: no constants of the material, because no simulation with the refined particles is finite"
        )
    return Identified(
        best,
        ties,
        {**fits, **compared},
        [video.frames[: video.fitted] for video in videos],
        [video.frames[video.fitted :] for video in videos],
        sum(video.rollouts for video in videos),
        models[0].grid,
        settings,
        material,
        [fit.family.name for fit in compared.values() if math.isfinite(fit.score)],
    )


def _on_finer_grid(
    running: Sequence[FamilyRun],
    fits: Mapping[str, FamilyFit],
    videos: Sequence[VideoResiduals],
    settings: IdentifyConfig,
) -> dict[str, FamilyRun]:
    """Fits to the first frames on the finer grid, by name, which continue those on the grid of the model.

    They are of at most `_CONTENDERS` families whose held-out loss is at most ``prune_factor`` times the lowest, and of
    the best family with each return map whose held-out loss is at most the square of it, and the uniform ones of these.

    Images of the finer grid may differ by more than a pixel, hence the fit at the coarsest level first, unless a near
    family has been fitted there, or the grid is the same. Derivatives are those of the coarse grid until a step fails.
    Those with ``prune_factor`` times the lowest loss are not alive, nor those that do not lower the loss of a family
    with fewer constants by ``penalty`` for each additional one, nor those with a field whose ratio differs from 1 by a
    factor that is similar to its change from the other particles and grid.
    """
    ranked = sorted((run for run in running if run.alive), key=lambda run: fits[run.family.name].score)
    lowest, factor = fits[ranked[0].family.name].score if ranked else 0.0, math.log(settings.prune_factor)
    excess = {run: fits[run.family.name].score - lowest for run in ranked}
    first = {run.family.return_map: run for run in reversed(ranked)}
    close = [run for run in ranked[:_CONTENDERS] if excess[run] <= factor]
    contenders = dict.fromkeys([*close, *(run for run in first.values() if excess[run] <= 1.5 * factor)])
    contenders |= dict.fromkeys(
        run for run in ranked if any(own.family.varies(run.family) for own in contenders)
    )
    coarse = {run.family.name: run.values for run in contenders}
    flowing, last = [run for run in contenders if run.family.flows], len(settings.pyramid) - 1
    fine: dict[str, FamilyRun] = {}
    for run in sorted(contenders, key=lambda run: len(run.family.constants)):
        if _is_redundant(run, flowing):
            continue
        again = FamilyRun(run.family, videos, [video.fitted for video in videos], settings, fine=True)
        done = [each for each in fine.values() if each.alive]
        near = [each for each in done if _is_near(run.family, each.family)]
        if near or settings.refinement == 1:
            starts = [run.family.with_guesses({**run.values, **each.values}) for each in near]
            again.begin(starts or [run.values], last, [*near, run][0].deviations, like=[run], rough=True)
        else:
            again.begin([run.values], 0, run.deviations, like=[run])
            if again.alive:
                limit = settings.prune_factor * min((each.fit.cost for each in done), default=math.inf)
                again.refine(last, rough=True, limit=limit)
        fine[run.family.name] = again
    done = [run for run in fine.values() if run.alive]
    for run in done:
        more = {each: len(run.family.constants) - len(each.family.constants) for each in done}
        simpler = [each.fit.cost * math.exp(-settings.penalty * n) for each, n in more.items() if n > 0]
        run.alive = run.fit.cost <= min(
            [settings.prune_factor * min(each.fit.cost for each in done), *simpler]
        )
    _keep_uniform(done)
    for run in done:
        if run.family.field:
            ratio, before = (math.log(values["ratio"]) for values in (run.values, coarse[run.family.name]))
            run.alive = run.alive and abs(ratio) > _CLEAR * abs(ratio - before)
    return fine


def _log_fits(fits: Iterable[FamilyFit], where: str, log: Callable[[str], None]) -> None:
    """A line for every family."""
    for fit in fits:
        log(
            f"{fit.family.name}{where}: loss {fit.loss:.3e}, held out {fit.held_out:.3e}, {fit.rollouts} rollouts, "
            + ", ".join(f"{key} {value:.4g}" for key, value in fit.values.items())
        )


def _fit_to_first(
    family: Family, video: VideoResiduals, guesses: Sequence[Values], settings: IdentifyConfig
) -> FamilyRun:
    """Fit of a family to the first video alone, at all levels."""
    run = FamilyRun(family, [video], [video.fitted], settings)
    run.begin(guesses)
    for level in range(1, len(settings.pyramid) if run.alive else 1):
        run.refine(level, rough=True)
    return run


def _first_fit(
    family: Family,
    videos: Sequence[VideoResiduals],
    running: Sequence[FamilyRun],
    guesses: Sequence[Values],
    settings: IdentifyConfig,
) -> FamilyRun:
    """Fit of a family at the coarsest level, the better of two for a family with plastic flow.

    An elastic body is a limit of most of these families. At a coarse level, a very soft elastic body often fits better
    than any flow before its fit, but it is a local minimum because it never yields. One fit therefore starts from
    guesses with weaker limits of the flow. The other starts from the fits of other families, also nearer to their
    elastic limit, if that is better than the result of the first. Redundant fits are used only if there is no other.
    The first fit of an elastic body with a field starts from the best uniform one with other ratios.
    """
    fitted = [family.with_guesses(values) for values in _fitted_values(running, family)]
    groups = [[*guesses, *fitted]]
    if family.flows and fitted:
        flowing = [*guesses, *family.with_other_limits(guesses[-1], (-1, -2))]
        groups = [flowing, [*fitted, *family.with_other_limits(fitted[0], (1, 2))]]
    elif family.field and fitted:
        groups = [family.with_other_limits(fitted[0], (-1, 1)), groups[0]]
    fits = [FamilyRun(family, videos, [video.fitted for video in videos], settings) for _ in groups]
    lowest = math.inf
    for run, starts in zip(fits, groups, strict=True):
        run.begin(starts, below=lowest)
        lowest = run.fit.cost if run.alive else math.inf
    best = min(fits, key=lambda run: (not run.alive, _is_redundant(run, running), run.loss))
    best.rollouts = sum(run.rollouts for run in fits)
    return best


def _is_near(family: Family, other: Family) -> bool:
    """Whether the fit of another family is near one of this: it has the same constants, or flows and is a limit."""
    return family.constants == other.constants or other.flows and family.contains(other)


def _late_fit(
    family: Family,
    videos: Sequence[VideoResiduals],
    running: Sequence[FamilyRun],
    settings: IdentifyConfig,
    level: int,
    rough: bool,
) -> FamilyRun:
    """Fit of a family at a level from those of near families."""
    near = [run for run in running if _is_near(family, run.family)]
    run = FamilyRun(family, videos, [video.fitted for video in videos], settings)
    run.begin([family.with_guesses(other.values) for other in near], level, like=near, rough=rough)
    return run


def _better_later(running: Sequence[FamilyRun]) -> list[tuple[FamilyRun, FamilyRun]]:
    """Pairs of a fit and a better one that started later: the best of all, and the best with the same constants."""
    ranked, pairs = sorted((run for run in running if run.alive), key=lambda run: run.fit.cost), []
    for at, run in enumerate(running):
        same = [other for other in ranked if other.family.constants == run.family.constants]
        leaders = dict.fromkeys([*ranked[:1], *same[:1]])
        pairs += [(run, best) for best in leaders if run.alive and best in running[at + 1 :]]
    return pairs


def _prune(running: Sequence[FamilyRun], settings: IdentifyConfig, keep_redundant: bool = False) -> None:
    """Drop redundant families, and those whose loss exceeds ``prune_factor`` times the best with their return map, or
    the square of it times the best of all.

    Return maps are hardly compared, because the error of a coarse grid, at thin limbs and near the floor, is like
    plastic flow. Families that do not improve on a simpler one at a coarse level are kept, since finer levels have more
    information, and redundant ones with ``keep_redundant``, for a finer grid. The uniform family of one with a field is
    kept as long as that one, because held-out frames compare them.
    """
    alive = [run for run in running if run.alive]
    best = min((run.fit.cost for run in alive), default=math.inf)
    for run in alive:
        lowest = min(other.fit.cost for other in alive if other.family.return_map == run.family.return_map)
        run.alive = run.fit.cost <= min(settings.prune_factor * lowest, settings.prune_factor**2 * best)
    _keep_uniform(alive)
    kept = [run for run in alive if run.alive]
    for run in [] if keep_redundant else [run for run in kept if _is_redundant(run, kept)]:
        run.alive = False


def _keep_uniform(runs: Iterable[FamilyRun]) -> None:
    """Keep the uniform family of each one with a field that is kept."""
    fields = [run.family for run in runs if run.alive]
    for run in runs:
        run.alive = run.alive or any(family.varies(run.family) for family in fields)


def _is_redundant(run: FamilyRun, others: Sequence[FamilyRun]) -> bool:
    """Whether a family that this one contains has the same images, so that its additional constants are at limits."""
    return any(run.alive and o.alive and run.family.contains(o.family) and run.resembles(o) for o in others)


def _fitted_values(running: Sequence[FamilyRun], family: Family) -> list[Values]:
    """Starts from other families: constants of the best one, and of the largest ones that ``family`` contains."""
    alive = [run for run in running if run.alive]
    inner = [run for run in alive if family.contains(run.family)]
    size = max((len(run.family.constants) for run in inner), default=0)
    best = sorted(alive, key=lambda run: run.fit.cost)[:1]
    return [run.values for run in [*best, *(run for run in inner if len(run.family.constants) == size)]]


def select_family(fits: Sequence[FamilyFit], settings: IdentifyConfig) -> tuple[FamilyFit, list[str]]:
    """The family with the lowest score, and the names of tied families.

    A family with a field is not selected if it ties with the uniform one, because errors of the particles that sample
    the body are like a field. A family that contains the selected one is not tied unless its score is lower, because
    its additional constants do not help.
    """
    best = min(
        (
            fit
            for fit in fits
            if not any(
                fit.family.varies(other.family) and other.score - fit.score < settings.tie for other in fits
            )
        ),
        key=lambda fit: fit.score,
    )
    if not math.isfinite(best.score):
        raise NonFiniteError("identify", "every candidate diverges. Use softer guesses in identify.families")
    return best, [
        fit.family.name
        for fit in fits
        if fit is not best
        and fit.score - best.score < settings.tie
        and not (fit.family.contains(best.family) and fit.score >= best.score)
    ]
