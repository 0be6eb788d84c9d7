"""Muscle tracks: a face whose controls are weights of blendshapes and the jaw.

Blendshapes say where muscles want to go, flesh says where skin can go. Every shape of a person is
carried from the skin into the flesh once, so that for any weights each muscle has a target volume
and a target centre line. Springs pull the muscle to the volume, the line's length is its
activation, and the flesh comes to rest between them, bones and whatever touches (Bao, Cong, Grabli
and Fedkiw, High-quality face capture using anatomical muscles, CVPR 2019).

    shapes of the skin -> without the jaw -> morphs of the flesh -> targets, lines -> springs -> x

:mod:`~solver.tracks.shapes`, :mod:`~solver.tracks.lines`, :mod:`~solver.tracks.basis`,
:mod:`~solver.tracks.springs` and :mod:`~solver.tracks.face`, in that order.
:mod:`~solver.tracks.fit` finds weights and jaw of a scan, by the flesh or by the plain shapes of
:mod:`~solver.tracks.plain`.
"""
