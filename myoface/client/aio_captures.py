"""The calls about templates, subjects and their scans."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx

from myoface.client.aio_access import AsyncAccess
from myoface.client.answers import read_json
from myoface.client.files import (
    Transferred,
    async_count_vertices,
    async_sha256_of,
    ignore_transfer,
    require_vertices,
)
from myoface.client.scan_packing import async_with_images
from myoface.names import NamedScan, name_scans, same_file
from myoface.resources import (
    Capture,
    LabelChanges,
    LabelFilter,
    Labels,
    SignedUrl,
    Subject,
    Template,
    as_query,
)
from myoface.roles import NO_SCANS, Role
from myoface.tenant import Deletion, Limits


class AsyncCaptures(AsyncAccess):
    """Calls of a capture station: people, their scans, and the files of both."""

    # Templates and subjects

    async def create_template(
        self, name: str, path: Path, *, progress: Transferred = ignore_transfer
    ) -> Template:
        """Upload a template anatomy (NPZ) and register it."""
        sent = await self.upload(path, progress=progress)
        return await self._create("/v1/templates", Template, name=name, upload_id=sent.id)

    async def templates(self) -> list[Template]:
        """Return the template anatomies, newest first."""
        return await self._list("/v1/templates", Template)

    async def delete_template(self, template_id: str) -> str:
        """Delete a template that no subject has; returns the id of the receipt."""
        return await self._delete(f"/v1/templates/{template_id}")

    async def create_subject(
        self, name: str, *, template_id: str | None = None, labels: Labels | None = None
    ) -> Subject:
        """Register a person; without a template the built-in anatomy is used."""
        return await self._create(
            "/v1/subjects", Subject, name=name, template_id=template_id, labels=labels
        )

    async def subjects(self, *, labels: LabelFilter | None = None) -> list[Subject]:
        """Return the subjects, newest first, those with all of ``labels`` if they are given.

        A label of None has any value.
        """
        return await self._list("/v1/subjects", Subject, label=as_query(labels))

    async def change_subject(
        self, subject_id: str, *, name: str | None = None, labels: LabelChanges | None = None
    ) -> Subject:
        """Give a person another name or labels; a label of None goes, those not named stay."""
        return await self._change(f"/v1/subjects/{subject_id}", Subject, name=name, labels=labels)

    async def subject(self, subject_id: str) -> Subject:
        """Return one subject."""
        return await self._get(f"/v1/subjects/{subject_id}", Subject)

    async def delete_subject(self, subject_id: str, *, cancel: bool = False) -> str:
        """Delete a subject with all its scans, jobs and rigs; returns the id of the receipt.

        ``cancel`` stops its jobs first; without it a subject with jobs is refused.
        """
        return await self._delete(f"/v1/subjects/{subject_id}", cancel=str(cancel).lower())

    async def deletion(self, deletion_id: str) -> Deletion:
        """Return the receipt of a deletion."""
        return await self._get(f"/v1/deletions/{deletion_id}", Deletion)

    # Scans and files

    async def signed_url(self, artifact_id: str) -> str:
        """Return a URL of a file that works without a key for a few minutes."""
        response = await self._request("POST", f"/v1/artifacts/{artifact_id}/url")
        return str(httpx.URL(self._url).join(SignedUrl.read(read_json(response)).url))

    async def add_capture(
        self,
        subject_id: str,
        path: Path,
        *,
        role: Role | None = None,
        name: str | None = None,
        registered: bool = False,
        landmarks: Path | None = None,
        mask: Path | None = None,
        replaces: str | None = None,
        title: str | None = None,
        labels: Labels | None = None,
        progress: Transferred = ignore_transfer,
    ) -> Capture:
        """Upload a scan and add it to a subject; name and role are the file's unless given.

        ``registered`` scans have the template's vertices, which are counted first; others are what
        the scanner made. ``landmarks`` is a file, of a photograph the JSON of what is known of it.
        A raw OBJ or PLY goes with its MTL files and images as a ZIP. ``mask`` is a PNG that is
        white where a photograph counts. The service deletes the capture ``replaces`` in the same
        step that adds this one.
        :mod:`myoface.names` says what name and role a file has; the title is what the file is
        called.
        """
        (scan,) = name_scans([path], names=[name], roles=[role])
        if registered:
            await self._require_vertices([scan], subject_id)
        marks = None if landmarks is None else (await self.upload(landmarks)).id
        shown = None if mask is None else (await self.upload(mask)).id
        packed = scan.role not in NO_SCANS and not registered
        sent = await self._upload_scan(path, progress, packed=packed)
        return await self._create(
            f"/v1/subjects/{subject_id}/captures",
            Capture,
            name=scan.name,
            role=scan.role,
            upload_id=sent,
            registered=registered or scan.role in NO_SCANS,
            landmarks_upload_id=marks,
            mask_upload_id=shown,
            replaces=replaces,
            title=title,
            labels=labels,
        )

    async def _upload_scan(self, path: Path, progress: Transferred, *, packed: bool) -> str:
        """Upload a scan, ``packed`` with the images that it names; return the upload's id."""
        with TemporaryDirectory() as folder:
            file = await async_with_images(path, Path(folder)) if packed else path
            return (await self.upload(file, progress=progress)).id

    async def change_capture(
        self,
        subject_id: str,
        capture_id: str,
        *,
        name: str | None = None,
        title: str | None = None,
        role: Role | None = None,
        labels: LabelChanges | None = None,
    ) -> Capture:
        """Give a scan another name, title, role or labels; a label of None goes, others stay.

        Name and role stay while the subject has jobs that are not over (``subject.busy``).
        """
        url = f"/v1/subjects/{subject_id}/captures/{capture_id}"
        return await self._change(url, Capture, name=name, title=title, role=role, labels=labels)

    async def _require_vertices(self, scans: Iterable[NamedScan], subject_id: str | None) -> None:
        """Refuse scans that claim to be registered and have not the template's count of vertices.

        Without a subject the template is the built-in one.
        """
        template = subject_id and (await self.subject(subject_id)).template_id
        if template:
            expected = (await self._get(f"/v1/templates/{template}", Template)).vertices
        else:
            expected = (await self._get("/v1/limits", Limits)).builtin_vertices
        for scan in scans:
            if expected is not None and scan.role not in NO_SCANS:
                require_vertices(scan.path, await async_count_vertices(scan.path), expected)

    async def ensure_capture(
        self,
        subject_id: str,
        path: Path,
        *,
        role: Role | None = None,
        name: str | None = None,
        registered: bool = False,
        landmarks: Path | None = None,
        mask: Path | None = None,
        replace: bool = False,
        title: str | None = None,
        labels: Labels | None = None,
        progress: Transferred = ignore_transfer,
    ) -> Capture:
        """Return a file's capture: the one there is of the same bytes, or see :meth:`add_capture`.

        A photograph that has no ``mask`` of this name yet is another capture.

        ``replace`` puts the file in the place of another one's capture of this name, or of its own
        that was sent without its images; without it the service refuses the name.
        """
        (scan,) = name_scans([path], names=[name], roles=[role])
        is_registered = registered or scan.role in NO_SCANS
        known = {same_file(each.name): each for each in await self.captures(subject_id)}
        before = known.get(same_file(scan.name))
        is_same = (
            before is not None
            and (before.role, before.registered) == (scan.role, is_registered)
            and (mask is None or before.mask == mask.name)
            and before.sha256 in await self._digests(path, packed_only=replace)
        )
        if before is None or not is_same:
            return await self.add_capture(
                subject_id,
                path,
                role=scan.role,
                name=scan.name,
                registered=is_registered,
                landmarks=landmarks,
                mask=mask,
                replaces=before.id if before is not None and replace else None,
                title=title,
                labels=labels,
                progress=progress,
            )
        if landmarks is not None:
            before = await self.set_landmarks(subject_id, before.id, landmarks)
        if title is not None or labels is not None:
            before = await self.change_capture(subject_id, before.id, title=title, labels=labels)
        return before

    async def _digests(self, path: Path, *, packed_only: bool) -> set[str]:
        """Return the digests that a file has with its images and, if it may, without them."""
        with TemporaryDirectory() as folder:
            packed = await async_with_images(path, Path(folder))
            files = {packed} if packed_only else {path, packed}
            return {await async_sha256_of(each) for each in files}

    async def captures(
        self, subject_id: str, *, labels: LabelFilter | None = None
    ) -> list[Capture]:
        """Return a subject's scans, newest first, those with all of ``labels`` if given.

        A label of None has any value.
        """
        url = f"/v1/subjects/{subject_id}/captures"
        return await self._list(url, Capture, label=as_query(labels))

    async def capture(self, subject_id: str, capture_id: str) -> Capture:
        """Return one scan, with its newest check and registration."""
        return await self._get(f"/v1/subjects/{subject_id}/captures/{capture_id}", Capture)

    async def set_landmarks(self, subject_id: str, capture_id: str, path: Path) -> Capture:
        """Upload landmarks on a scan, or a photograph's JSON, in place of those it had."""
        url = f"/v1/subjects/{subject_id}/captures/{capture_id}/landmarks"
        sent = await self.upload(path)
        response = await self._request("PUT", url, json={"upload_id": sent.id})
        return Capture.read(read_json(response))

    async def delete_capture(self, subject_id: str, capture_id: str) -> str:
        """Delete a scan with its checks and registrations; returns the id of the receipt."""
        return await self._delete(f"/v1/subjects/{subject_id}/captures/{capture_id}")
