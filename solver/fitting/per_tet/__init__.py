"""(P): six activations in every tet with muscle, the model that muscle geometry is compared with.

    f(a, b) = data(x) + w_act R_act(a) + w_sparse R_sparse(a)
              + w_volume sum_i v_i (det S(a_i) - 1)^2 + w_b/2 |D (b - b_start)|^2

with x the equilibrium of active and passive tissue (:mod:`.tissue`) and v_i tet i's part of all
muscle volume, so that no weight depends on the mesh's resolution (Ichim et al., Phace, SIGGRAPH
2017). Reduced-space Gauss-Newton as in :mod:`solver.fitting.activation`: x is eliminated. Before
each step for (a, b) every muscle's contraction is found for the activations at hand (local), then
a and b are solved for together (global; :mod:`.saddle`). :mod:`.descent` is the way down.
"""

from solver.fitting.per_tet.descent import PerTetFit, Status, fit
from solver.fitting.per_tet.objective import PER_TET, Objective, PerTetOptions, PerTetPriors

__all__ = ["PER_TET", "Objective", "PerTetFit", "PerTetOptions", "PerTetPriors", "Status", "fit"]
