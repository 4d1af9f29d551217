"""The rules of the answer in the order in which export fits them.

From features: unknown materials, hum and disturbances, displaced contacts, early answers. From
counts: contact, speeds, displacement, slides. From answers of the box: broken taxels, and which of
all rules pay.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from palpate.bundle.bundle import Bundle, Manifest
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.answer import (
    altered_sweeps,
    calibrate,
    embedding,
    fit_correlation,
    fit_early,
    fit_slide,
    fit_taxels,
    fit_window,
    rules,
    stranger_limits,
)
from palpate_train.answer.calibrate import Calibration, CalibrationInputs
from palpate_train.answer.embedding import Embedding
from palpate_train.answer.fit_contact import Contacts
from palpate_train.answer.fit_early import EarlyRule
from palpate_train.answer.rules import RULES, Asked
from palpate_train.export import trial
from palpate_train.export.bundle_graph import bundle_graph
from palpate_train.export.contents import Content
from palpate_train.models.recipe.fitted import Fit, calibration_inputs
from palpate_train.onnx_tools.graph_builder import run, slim


def from_features(
    content: Content, fit: Fit, pitch_mm: float | None, left_out: Collection[str]
) -> Content:
    """`content` with the calibration of `fit`, if it has one: heads, early answers, novelty, and
    the figures of heads that did not see the held-out sweeps. The rule for displaced contacts needs
    contact positions, and these need the distance between taxels. left_out: rules that the graph
    does not serve."""
    calibration = fit.calibration
    if calibration is None:
        return content
    if "early" in left_out:
        calibration = replace(calibration, rule=EarlyRule(None, "left out"))
    elif (why := fit_early.no_limits(len(content.held_out))) is not None:
        calibration = replace(calibration, rule=EarlyRule(None, why))
    if not (fit.contacts and fit.contacts.positions(pitch_mm)):
        calibration = replace(calibration, displacement=None)
    rule = calibration.rule
    trunk, prefixes = fit.trunk(), fit.trunk(prefixes=True) if rule.early else None
    given = fit.given or calibration_inputs(fit)
    apart = _unseen(given, calibration)
    few = bool(given.junk.keys() - {NOT_THIS}) or altered_sweeps.few(fit.held)
    found = None if few else _widened(fit, apart.embedding, calibration.embedding)
    classes = [apart.classes(), calibration.classes()]
    judged = _limited(found, given, calibration, fit, "unknown" not in left_out)
    beyond, figures = judged.limits, replace(fit, calibration=judged).held_out_figures()
    early = {"lost": rule.lost, "n": rule.n} if rule.early else rule.why
    content = replace(content, known=beyond.known(calibration.class_mean_temperature))
    if found:
        content = replace(content, disturbances=found.disturbances)
        wider = zip(classes, found.shapes, found.changes, strict=True)
        classes = [replace(of, shapes=shapes, changes=moved) for of, shapes, moved in wider]
        figures |= {altered_sweeps.FIGURES: found.figures}
    content = replace(
        content,
        unseen=replace(content, model=bundle_graph(apart, trunk), classes=classes[0]),
        model=bundle_graph(calibration, trunk, prefixes),
        early=rule.early,
        displacement=displaced.rule if (displaced := calibration.displacement) else None,
        classes=classes[1],
        about=content.about | {"early": early},
        figures=content.figures | figures,
    )
    content = _early_checked(content)
    if "unknown" in left_out:
        content.figures.pop(stranger_limits.FIGURES)
    return content


def _early_checked(content: Content) -> Content:
    """`content` whose early answers need a known material."""
    if not (content.early and content.classes):
        return content
    kept = stranger_limits.answered(content.figures[stranger_limits.FIGURES])
    classes, limits = fit_early.measure(content.model, content.train, content.held_out, kept)
    return replace(
        content,
        early=replace(content.early, limits=limits),
        classes=replace(content.classes, early=classes),
    )


def _limited(
    found: altered_sweeps.Widened | None,
    given: CalibrationInputs,
    calibration: Calibration,
    fit: Fit,
    applied: bool,
) -> Calibration:
    """`calibration` with the limits of known materials, for the widened shapes if there are any,
    and with the held-out sweeps that are within them; all are if the limits are not `applied`."""
    whole = calibration.embedding
    if found:
        distances = altered_sweeps.left_out_in_turn(found, given, whole)
        whole = replace(whole, shapes=found.shapes[1])
    else:
        distances = calibrate.left_out_in_turn(given, whole)
    cost, junk = fit.about.get(stranger_limits.COST, 1.0), calibrate.junk_distances(given, whole)
    beyond = stranger_limits.limits(distances, cost, junk)
    most = np.log(beyond.balanced) if applied else np.inf
    held = {
        name: replace(of, known=distances[name].corrected()[0][of.numbers] <= most)
        for name, of in calibration.held.items()
    }
    return replace(calibration, limits=beyond, held=held)


def _widened(fit: Fit, apart: Embedding, whole: Embedding) -> altered_sweeps.Widened | None:
    """Shapes of known materials that know how altered sweeps differ. apart: an embedding that did
    not see the held-out sweeps."""
    features = partial(run, fit.trunk())
    seed = int(fit.about["seed"])
    return altered_sweeps.measure(
        features, fit.train, fit.held, apart, whole, tare=fit.tare, seed=seed
    )


def _unseen(given: CalibrationInputs, calibration: Calibration) -> Calibration:
    """`calibration` with a head and an embedding that did not see the groups of the held-out
    sweeps."""
    seen = ~np.isin(given.groups, given.groups[given.held])
    weight, bias = given.naming_head(seen)
    return replace(
        calibration,
        embedding=embedding.in_two_views(
            given.whole[seen], given.labels[seen], given.fixed, given.beyond
        ),
        weight=weight / calibration.temperature,
        bias=bias / calibration.temperature,
    )


def from_counts(manifest: Manifest, content: Content, pitch_mm: float | None) -> Manifest:
    """`manifest` with the rules that the counts of the training sweeps give. pitch_mm: as for
    pack.pack."""
    train, contacts = content.train, content.contacts or Contacts.of(content.train)
    place = contacts.positions(pitch_mm)
    limits = replace(manifest.thresholds, contact=contacts.limit.contact)
    limits = fit_window.fitted(limits, (train, content.held_out), contacts.limit.tare)
    speeds, unmeasured = fit_slide.trained_speeds(train, place.pitch_mm if place else None)
    unknown = {"contact": contacts.limit.why, "speeds": unmeasured}
    manifest = replace(
        manifest,
        thresholds=limits,
        contact=place,
        unloaded=contacts.limit.known_tare(),
        speeds=speeds,
        displacement=content.displacement,
        correlations=fit_correlation.limits(train, content.held_out),
        made=manifest.made
        | {f"{part}_unknown_because": why for part, why in unknown.items() if why},
    )
    for rule in RULES.values():
        manifest = rule.limited(manifest, train)
    return manifest


def from_answers(content: Content, packed: Bundle, proven: bool, asked: Asked) -> Bundle:
    """`packed` with the broken taxels that it tolerates, if that is `proven`, and without the rules
    that do not pay. Heads judge that have not seen the held-out sweeps. A skin may have taxels
    without a signal in sound sweeps; no broken taxel is bridged on it. Nothing answers early where
    no limit tells a slide from a rest."""
    left_out, figures = list(asked.left_out), dict[str, Any]()
    seed = int(content.about.get("seed", 0))
    if proven:
        judging = packed
        if content.unseen:
            model = slim(content.unseen.model).SerializeToString()
            manifest = replace(packed.manifest, early=None)
            classes = content.unseen.classes
            judging = replace(packed, manifest=manifest, model=model, classes=classes)
        silent = packed.manifest.thresholds.dead_taxels
        measured = judging, content.train, content.held_out, seed
        if not silent and (found := fit_taxels.measure(*measured)):
            packed, judging = (
                replace(of, manifest=found.written(of.manifest)) for of in (packed, judging)
            )
        left_out, figures = trial.decided(judging, content.held_out, seed, asked)
        for name in set(asked.kept) - set(rules.present(packed)):
            figures[name] = {"kept": False, "because": "absent"}
    for name in left_out:
        packed = RULES[name].without(packed)
    if packed.manifest.early and not packed.manifest.sliding:
        made = packed.manifest.made | {"early": fit_slide.UNNOTICED}
        packed = RULES["early"].without(
            replace(packed, manifest=replace(packed.manifest, made=made))
        )
    figures = {rules.FIGURES: figures} if figures else {}
    several = len(np.unique(content.held_out.labels)) > 1  # junk is made of two materials
    if proven and several and packed.manifest.early:
        figures[fit_early.FIGURES] = trial.early_answers(packed, content.held_out, seed)
    return replace(
        packed, manifest=replace(packed.manifest, figures=packed.manifest.figures | figures)
    )
