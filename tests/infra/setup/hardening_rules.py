"""What every container of ours must have, as rules over the files that describe them."""

from collections.abc import Iterator, Mapping
from typing import Any

_SERVES = {"Deployment"}


def faults_of_manifests(documents: list[dict[str, Any]], job: Mapping[str, Any]) -> Iterator[str]:
    """Say what is missing in manifests of Kubernetes, and in the template of the flows' job."""
    for row in documents:
        if row["kind"] in ("Deployment", "Job"):
            pod = row["spec"]["template"]["spec"]
            yield from _faults_of_pod(row["metadata"]["name"], pod, row["kind"] in _SERVES)
    pod = job["job_configuration"]["job_manifest"]["spec"]["template"]["spec"]
    yield from _faults_of_pod("job template", pod, serves=False)
    yield from _faults_of_namespace(documents)


def _faults_of_pod(name: str, pod: Mapping[str, Any], serves: bool) -> Iterator[str]:
    mine = pod.get("securityContext", {})
    if not mine.get("runAsNonRoot") or not mine.get("runAsUser"):
        yield f"{name}: may be root"
    if mine.get("seccompProfile") != {"type": "RuntimeDefault"}:
        yield f"{name}: no seccomp profile"
    if any(pod.get(key) for key in ("hostNetwork", "hostPID", "hostIPC")):
        yield f"{name}: shares the host's namespaces"
    if any("hostPath" in volume for volume in pod.get("volumes", ())):
        yield f"{name}: mounts the host's files"
    for container in pod["containers"]:
        given = container.get("securityContext", {})
        if given.get("capabilities") != {"drop": ["ALL"]} or given.get("privileged"):
            yield f"{name}: keeps capabilities"
        if given.get("allowPrivilegeEscalation") is not False:
            yield f"{name}: may gain privileges"
        if not given.get("readOnlyRootFilesystem"):
            yield f"{name}: writes to its image"
        for kind in ("requests", "limits"):
            if set(container.get("resources", {}).get(kind, ())) < {"cpu", "memory"}:
                yield f"{name}: no {kind}"
        if serves and "livenessProbe" not in container:
            yield f"{name}: nothing asks whether it lives"


def _faults_of_namespace(documents: list[dict[str, Any]]) -> Iterator[str]:
    hard = [row["spec"]["hard"] for row in documents if row["kind"] == "ResourceQuota"]
    if not hard or not {"limits.cpu", "limits.memory", "pods"} <= set(hard[0]):
        yield "namespace: no quota"
    policies = [row["spec"] for row in documents if row["kind"] == "NetworkPolicy"]
    closed = {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    if closed not in policies:
        yield "namespace: open to the network by default"
    for policy in policies:
        for rule in (*policy.get("ingress", ()), *policy.get("egress", ())):
            if not rule.get("ports"):
                yield "namespace: a rule of the network names no port"


def faults_of_services(compose: Mapping[str, Any]) -> Iterator[str]:
    """Say what is missing in services of a compose file."""
    for name, service in compose["services"].items():
        if service.get("cap_drop") != ["ALL"] or service.get("privileged"):
            yield f"{name}: keeps capabilities"
        if not service.get("read_only"):
            yield f"{name}: writes to its image"
        options = service.get("security_opt", ())
        if "no-new-privileges:true" not in options:
            yield f"{name}: may gain privileges"
        if any("unconfined" in option for option in options):
            yield f"{name}: no seccomp profile"
        if any("docker.sock" in volume for volume in service.get("volumes", ())):
            yield f"{name}: holds the socket of Docker"
        if service.get("network_mode") == "host" or service.get("pid") == "host":
            yield f"{name}: shares the host's namespaces"


def unpinned_images(texts: Mapping[str, str], compose: Mapping[str, Any]) -> set[str]:
    """Return the foreign images without a digest: of each FROM, and of services."""
    named: set[str] = set()
    for text in texts.values():
        lines = [line.split() for line in text.splitlines() if line.startswith("FROM ")]
        stages = {words[-1] for words in lines if "AS" in words}
        named |= {words[1] for words in lines if words[1] not in stages}
    named |= {
        row["image"] for row in compose["services"].values() if "trilight" not in row["image"]
    }
    return {image for image in named if "@sha256:" not in image}
