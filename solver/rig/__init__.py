"""The result of a fit, its exports and its pictures."""

from solver.rig.rig import ExpressionFit as ExpressionFit
from solver.rig.rig import Rig as Rig
from solver.rig.rig import System as System
from solver.rig.rig import SystemFit as SystemFit
from solver.rig.rig import find_files as find_files
