"""The result of a fit, its exports and its pictures."""

from solver.rig.expression import ExpressionFit as ExpressionFit
from solver.rig.rig import Rig as Rig
from solver.rig.rig import find_files as find_files
from solver.rig.system import ShapeFit as ShapeFit
from solver.rig.system import ShapeSystem as ShapeSystem
from solver.rig.system import System as System
from solver.rig.system import TetFit as TetFit
from solver.rig.system import TetSystem as TetSystem
