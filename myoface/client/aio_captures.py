"""The calls about templates, subjects and their scans."""

from __future__ import annotations

from pathlib import Path

import httpx

from myoface.client.aio_access import AsyncAccess
from myoface.client.answers import read_json
from myoface.client.files import Transferred, async_sha256_of, ignore_transfer
from myoface.names import Role, name_scans, same_file
from myoface.resources import NO_SCANS, Capture, Deletion, SignedUrl, Subject, Template


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

    async def create_subject(self, name: str, *, template_id: str | None = None) -> Subject:
        """Register a person; without a template the built-in anatomy is used."""
        return await self._create("/v1/subjects", Subject, name=name, template_id=template_id)

    async def subjects(self) -> list[Subject]:
        """Return the subjects, newest first."""
        return await self._list("/v1/subjects", Subject)

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
        replaces: str | None = None,
        progress: Transferred = ignore_transfer,
    ) -> Capture:
        """Upload a scan and add it to a subject; name and role are the file's unless given.

        ``registered`` scans have the template's vertices, others are what the scanner made;
        ``landmarks`` is a file. The service deletes the capture ``replaces`` in the same step that
        adds this one.
        :mod:`myoface.names` says what name and role a file has.
        """
        (scan,) = name_scans([path], names=[name], roles=[role])
        marks = None if landmarks is None else (await self.upload(landmarks)).id
        sent = await self.upload(path, progress=progress)
        return await self._create(
            f"/v1/subjects/{subject_id}/captures",
            Capture,
            name=scan.name,
            role=scan.role,
            upload_id=sent.id,
            registered=registered or scan.role in NO_SCANS,
            landmarks_upload_id=marks,
            replaces=replaces,
        )

    async def ensure_capture(
        self,
        subject_id: str,
        path: Path,
        *,
        role: Role | None = None,
        name: str | None = None,
        registered: bool = False,
        landmarks: Path | None = None,
        replace: bool = False,
        progress: Transferred = ignore_transfer,
    ) -> Capture:
        """Return a file's capture: the one there is of the same bytes, or see :meth:`add_capture`.

        ``replace`` puts the file in the place of another one's capture of this name; without it
        the service refuses the name.
        """
        (scan,) = name_scans([path], names=[name], roles=[role])
        is_registered = registered or scan.role in NO_SCANS
        known = {same_file(each.name): each for each in await self.captures(subject_id)}
        before = known.get(same_file(scan.name))
        is_same = before is not None and (
            (before.role, before.registered) == (scan.role, is_registered)
            and before.sha256 == await async_sha256_of(path)
        )
        if before is None or not is_same:
            return await self.add_capture(
                subject_id,
                path,
                role=scan.role,
                name=scan.name,
                registered=is_registered,
                landmarks=landmarks,
                replaces=before.id if before is not None and replace else None,
                progress=progress,
            )
        if landmarks is not None:
            return await self.set_landmarks(subject_id, before.id, landmarks)
        return before

    async def captures(self, subject_id: str) -> list[Capture]:
        """Return a subject's scans, newest first."""
        return await self._list(f"/v1/subjects/{subject_id}/captures", Capture)

    async def capture(self, subject_id: str, capture_id: str) -> Capture:
        """Return one scan, with its newest check and registration."""
        return await self._get(f"/v1/subjects/{subject_id}/captures/{capture_id}", Capture)

    async def set_landmarks(self, subject_id: str, capture_id: str, path: Path) -> Capture:
        """Upload landmarks on a scan, in place of those it had."""
        url = f"/v1/subjects/{subject_id}/captures/{capture_id}/landmarks"
        sent = await self.upload(path)
        response = await self._request("PUT", url, json={"upload_id": sent.id})
        return Capture.read(read_json(response))

    async def delete_capture(self, subject_id: str, capture_id: str) -> str:
        """Delete a scan with its checks and registrations; returns the id of the receipt."""
        return await self._delete(f"/v1/subjects/{subject_id}/captures/{capture_id}")
