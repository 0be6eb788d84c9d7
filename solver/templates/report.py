"""Report on a template as anatomy: findings in plain words, and the figures behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.anatomy.muscle_weights import enclosed_volume
from solver.anatomy.template import Template
from solver.anatomy.tetrahedra import dihedral_angles, volumes
from solver.errors import Finding
from solver.templates.checks import (
    check_bones,
    check_depths,
    check_description,
    check_landmarks,
    check_mesh,
    check_muscles,
    check_skin,
)


@dataclass(frozen=True)
class TemplateReport:
    """Findings, the worst first, and ``figures`` (JSON values) about the template."""

    findings: tuple[Finding, ...]
    figures: dict[str, Any]

    @property
    def good(self) -> bool:
        """Tell whether the template can be used: there is no error."""
        return not any(finding.severity == "error" for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        return {
            "good": self.good,
            "findings": [
                {
                    "severity": finding.severity,
                    "code": finding.code,
                    **finding.context,
                    "message": finding.message,
                }
                for finding in self.findings
            ],
            "figures": self.figures,
        }


def report_template(template: Template) -> TemplateReport:
    """Return what is wrong with, or worth a look at, a template whose arrays fit together."""
    checks = (
        check_description,
        check_skin,
        check_bones,
        check_muscles,
        check_landmarks,
        check_depths,
        check_mesh,
    )
    findings = [finding for check in checks for finding in check(template)]
    findings.sort(key=lambda finding: finding.severity != "error")
    return TemplateReport(tuple(findings), template_figures(template))


def template_figures(template: Template) -> dict[str, Any]:
    """Return counts and sizes of a template as JSON values."""
    low, high = _bounds(template.skin.vertices[template.face_vertices])
    figures: dict[str, Any] = {
        "name": template.name,
        "version": template.version,
        "content_sha256": template.sha256,
        "source": template.source,
        "licence": template.licence,
        "skin_vertices": len(template.skin.vertices),
        "skin_triangles": len(template.skin.faces),
        "face_vertices": len(template.face_vertices),
        "face_size_mm": [round(float(size), 1) for size in high - low],
        "cranium_cm3": round(enclosed_volume(template.cranium) / 1000.0, 1),
        "mandible_cm3": round(enclosed_volume(template.mandible) / 1000.0, 1),
        "muscles": len(template.muscles),
        "muscle_cm3": {
            muscle.name: round(enclosed_volume(muscle.surface) / 1000.0, 3)
            for muscle in template.muscles
        },
        "landmarks": len(template.landmarks),
        "regions": {name: len(ids) for name, ids in template.regions.items()},
        "depths": len(template.depths),
        "identities": 0 if template.shapes is None else len(template.shapes.identity),
        "expressions": 0 if template.shapes is None else len(template.shapes.expressions),
    }
    if template.mesh is not None:
        mesh = template.mesh
        sizes = volumes(mesh.vertices, mesh.tets)
        figures["mesh"] = {
            "edge_mm": mesh.edge_mm,
            "vertices": len(mesh.vertices),
            "tets": len(mesh.tets),
            "volume_cm3": round(float(sizes.sum()) / 1000.0, 1),
            "inverted": int(np.sum(sizes <= 0)),
            "smallest_dihedral_deg": round(
                float(dihedral_angles(mesh.vertices, mesh.tets).min()), 2
            ),
            "candidates_per_tet": round(mesh.weights.nnz / len(mesh.tets) - 1.0, 2),
        }
    return figures


def _bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return points.min(axis=0), points.max(axis=0)
