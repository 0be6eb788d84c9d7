"""The covariances of a take's controls: steady ones, and what frames before make no surer."""

import numpy as np

from solver.fitting.markers.filter import ControlFilter, FilterOptions
from solver.fitting.prior import GaussianPrior

RATE = 60.0


def usual():
    """Return the prior of four controls, two of which go together."""
    covariance = np.diag([1.0, 0.5, 0.2, 0.1])
    covariance[0, 1] = covariance[1, 0] = 0.4
    return GaussianPrior(np.array([0.0, 1.0, 0.0, 2.0]), covariance)


def follow(options, frames):
    """Return what a filter knows after frames of the same evidence, and how often it was new."""
    tracker = ControlFilter(usual(), 1.0 / RATE, options)
    # of the last control next to nothing
    evidence = tracker.evidence(np.diag([200.0, 20.0, 30.0, 0.1]))
    known = None
    prior = usual()
    anew = 0
    for _ in range(frames):
        before = known
        known = tracker.after(prior, known, evidence)
        anew += known is not before
        prior = tracker.before(np.ones(4), known)
    return known, prior, anew


def test_steady_covariances_are_used_again():
    steady, prior, anew = follow(FilterOptions(), 300)
    exact, own, always = follow(FilterOptions(steady=0.0), 300)
    assert always == 300
    assert anew < 60
    for found, right in ((steady.spread, exact.spread), (steady.covariance, exact.covariance)):
        np.testing.assert_allclose(np.diag(found), np.diag(right), rtol=0.15)
    np.testing.assert_allclose(prior.mean, own.mean, atol=1e-12)
    np.testing.assert_allclose(prior.precision @ prior.covariance, np.eye(4), atol=1e-9)


def test_other_evidence_ends_what_was_steady():
    tracker = ControlFilter(usual(), 1.0 / RATE)
    much, little = (tracker.evidence(scale * np.eye(4)) for scale in (100.0, 1.0))
    known = None
    for _ in range(100):
        prior = usual() if known is None else tracker.before(usual().mean, known)
        known = tracker.after(prior, known, much)
    assert tracker.after(prior, known, much) is known
    for _ in range(100):
        prior = tracker.before(usual().mean, known)
        found = tracker.after(prior, known, little)
        assert (np.diag(found.spread) >= np.diag(known.spread) * 0.999).all()
        known = found
    alone = np.diag(little.alone.covariance)
    assert (np.diag(known.spread) <= alone).all()


def test_many_frames_make_nothing_surer_that_each_determines():
    tracker = ControlFilter(usual(), 1.0 / RATE)
    evidence = tracker.evidence(100.0 * np.eye(4))
    known = None
    for _ in range(50):
        prior = usual() if known is None else tracker.before(usual().mean, known)
        known = tracker.after(prior, known, evidence)
    one = np.diag(evidence.alone.covariance)
    np.testing.assert_allclose(np.diag(known.spread), one, rtol=0.02)
    assert (np.diag(known.covariance) < 0.85 * one).all()


def test_a_steady_spread_is_near_the_prior_at_any_rate_and_forgetting():
    for rate, forgetting in ((60.0, 1.0), (240.0, 1.0), (60.0, 10.0)):
        tracker = ControlFilter(usual(), 1.0 / rate, FilterOptions(forgetting=forgetting))
        known = tracker.after(usual(), None, tracker.evidence(100.0 * np.eye(4)))
        nothing = tracker.evidence(np.zeros((4, 4)))
        for _ in range(int(8.0 * forgetting * rate)):
            known = tracker.after(tracker.before(usual().mean, known), known, nothing)
        sd = np.sqrt(np.diag(known.spread) / usual().variance)
        assert sd.min() > 0.95
