"""Tracking: a face frame after frame, each from the one before.

One :class:`.tracker.Tracker` holds the state and what a frame leaves to the next; an observation
says what is seen of the face, where the head is in it, and how one frame of it is fitted:
:mod:`.dense` points in the order of the face's, and labelled points of a marker system
(:mod:`solver.fitting.markers.observation`). :mod:`.frame_solver` takes the steps.
"""
