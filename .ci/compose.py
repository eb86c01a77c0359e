"""compose.yaml on this machine: three green cars, and every container back after `docker kill`. Then compose/scale: a car in each of
two halls, seen at the centre.

    python3 .ci/compose.py PATH/TO/car-node PATH/TO/pitwall

The images are made from these binaries and the libraries that they need, so that nothing is downloaded and nothing is compiled.
Without a Docker daemon one is started as a plain process, and ended afterwards. Where neither is possible (no root, no dockerd, no
docker-compose) it says so and ends with 0. Where no zenoh image can be had, zenoh's Python package is the router; with neither, the halls
are left out.
"""

import contextlib
import functools
import io
import json
import os
import pathlib
import re
import shutil
import ssl
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request

FOLDER = os.path.join(os.path.dirname(__file__), "..", "compose")
FILE = os.path.join(FOLDER, "compose.yaml")
HALLS = os.path.join(FOLDER, "scale", "compose.yaml")
PROJECT = "pitwall-ci"
ZENOH = "eclipse/zenoh:1.10.2"
USER = 65532
# What a start or a restart may take on a busy machine [s].
PATIENCE = 180
FOLDERS = ["state", "recordings", "keys", "tmp", "for", *(f"for/{name}" for name in ("router", "pit", "car-1", "car-2", "car-3"))]
SERVICES = ["router", "pitwall", "car-1", "car-2", "car-3", "keeper-1", "keeper-2"]


def run(*words, **options):
    done = subprocess.run(words, check=False, capture_output=True, text=True, **options)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.returncode}: {done.stderr[-800:]}")
    return done.stdout


def skip(why):
    print(f"skipped: {why}")
    sys.exit(0)


class Daemon:
    """A Docker daemon: the machine's own, or one of ours."""

    def __init__(self, folder):
        self.process = None
        if os.environ.get("DOCKER_HOST") or self.answers():
            return
        if os.geteuid() != 0 or not shutil.which("dockerd"):
            skip("no Docker daemon answers, and none can be started")
        self.socket = os.path.join(folder, "docker.sock")
        os.environ["DOCKER_HOST"] = f"unix://{self.socket}"
        os.environ["DOCKER_SOCKET"] = self.socket
        log = open(os.path.join(folder, "dockerd.log"), "w")
        self.process = subprocess.Popen(
            ["dockerd", "--data-root", f"{folder}/data", "--exec-root", f"{folder}/exec", "--host", f"unix://{self.socket}",
             "--pidfile", f"{folder}/dockerd.pid", "--storage-driver", "vfs"],
            stdout=log, stderr=subprocess.STDOUT)
        deadline = time.monotonic() + 60
        while not self.answers():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.stop()
                print(open(log.name).read()[-600:])
                skip("dockerd does not start here")
            time.sleep(0.5)

    @staticmethod
    def answers():
        return subprocess.run(["docker", "version"], capture_output=True, check=False).returncode == 0

    def stop(self):
        if self.process:
            self.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(60)


def image(name, binary):
    """An image of a program and its libraries, like the last stages of the Dockerfile."""
    stripped = tempfile.NamedTemporaryFile()
    if not shutil.which("strip") or subprocess.run(["strip", "-o", stripped.name, binary], check=False).returncode:
        shutil.copy(binary, stripped.name)
    program = os.path.basename(binary)
    files = {f"usr/local/bin/{program}": stripped.name}
    for library in re.findall(r"(/\S+) \(0x", run("ldd", binary)):
        files[library.lstrip("/")] = os.path.realpath(library)
    tar = io.BytesIO()
    with tarfile.open(fileobj=tar, mode="w") as archive:
        for folder in FOLDERS:
            entry = tarfile.TarInfo(folder)
            entry.type, entry.mode, entry.uid, entry.gid = tarfile.DIRTYPE, 0o755, USER, USER
            archive.addfile(entry)
        parents = {str(parent) for path in files for parent in pathlib.PurePosixPath(path).parents} - {"."}
        for folder in sorted(parents):
            entry = tarfile.TarInfo(folder)
            entry.type, entry.mode = tarfile.DIRTYPE, 0o755
            archive.addfile(entry)
        for path, source in sorted(files.items()):
            entry = archive.gettarinfo(source, path)
            entry.uid = entry.gid = 0
            entry.mode = 0o755
            with open(source, "rb") as content:
                archive.addfile(entry, content)
    changes = [f'ENTRYPOINT ["/usr/local/bin/{program}"]', f"USER {USER}:{USER}"]
    words = ["docker", "import", *(word for change in changes for word in ("--change", change)), "-", name]
    subprocess.run(words, input=tar.getvalue(), check=True, capture_output=True)
    print(f"{name}: {len(tar.getvalue()) / 1e6:.0f} MB")


# A router with a configuration file, as zenohd -c. A library has no plugins.
ROUTER = """
import sys, threading, zenoh
config = zenoh.Config.from_file(sys.argv[2])
config.insert_json5("plugins/storage_manager", "null")
session = zenoh.open(config)
threading.Event().wait()
"""


def zenoh_image():
    """Zenoh's image, or one with its Python package in its place. False when there is neither."""
    if not subprocess.run(["docker", "image", "inspect", ZENOH], capture_output=True, check=False).returncode:
        return True
    with contextlib.suppress(subprocess.TimeoutExpired):
        if not subprocess.run(["docker", "pull", "-q", ZENOH], capture_output=True, check=False, timeout=60).returncode:
            return True
    try:
        import zenoh  # noqa: PLC0415: it is there or not
    except ImportError:
        return False
    python = os.path.realpath(sys.executable)
    package, library = os.path.dirname(zenoh.__file__), os.path.dirname(os.__file__)
    binaries = [python, *(str(path) for folder in (package, f"{library}/lib-dynload") for path in pathlib.Path(folder).glob("*.so"))]
    needed = {found for binary in binaries for found in re.findall(r"(/\S+) \(0x", run("ldd", binary))}

    def no_cache(entry):
        return None if "__pycache__" in entry.name or "/test" in entry.name else entry

    tar = io.BytesIO()
    with tarfile.open(fileobj=tar, mode="w") as archive:
        for path in sorted(needed | {python}):
            archive.add(os.path.realpath(path), path.lstrip("/"))
        archive.add(library, library.lstrip("/"), filter=lambda entry: None if "-packages" in entry.name else no_cache(entry))
        archive.add(package, "packages/zenoh", filter=no_cache)
        entry = tarfile.TarInfo("router.py")
        entry.size = len(ROUTER)
        archive.addfile(entry, io.BytesIO(ROUTER.encode()))
    changes = [f'ENTRYPOINT ["{python}", "/router.py"]', "ENV PYTHONPATH=/packages", f"ENV PYTHONHOME={sys.base_prefix}"]
    words = ["docker", "import", *(word for change in changes for word in ("--change", change)), "-", ZENOH]
    subprocess.run(words, input=tar.getvalue(), check=True, capture_output=True)
    return True


def halls(car_node, pitwall, folder):
    """Two halls and a centre: a car in each hall is seen at the centre, also after the centre was killed."""
    if not zenoh_image():
        print("compose/scale: left out, neither the image nor the Python package of zenoh is here")
        return
    cars = []
    try:
        compose("up", "-d", file=HALLS)
        for name, port in (("hall-a-1", 7451), ("hall-b-1", 7452)):
            cars.append(subprocess.Popen(
                [car_node, "run", "--source", "simulator", "--map", "club", "--car", name, "--connect", f"tcp/127.0.0.1:{port}", "--state",
                 f"{folder}/{name}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

        def seen():
            said = run(pitwall, "cars", "--json", "--insecure", "--connect", "tcp/127.0.0.1:7450", timeout=60)
            states = {car["car"]: car["state"] for car in json.loads(said)}
            return states == {"hall-a-1": "LOCALIZED", "hall-b-1": "LOCALIZED"}

        wait("a car in each hall, at the centre", seen)
        run("docker", "restart", "-t", "1", container("centre"))
        wait("both cars after the centre's restart", seen)
        print("two halls: a car in each is seen at the centre, before and after its restart")
    except SystemExit:
        for service in ("centre", "hall-a", "hall-b"):
            print(service, subprocess.run(["docker", "logs", "--tail", "20", container(service)], capture_output=True, text=True, check=False))
        raise
    finally:
        for car in cars:
            car.kill()
            car.wait()
        with contextlib.suppress(Exception):
            compose("down", "-v", "-t", "1", file=HALLS)


def compose(*words, file=FILE):
    tool = ["docker", "compose"] if not subprocess.run(["docker", "compose", "version"], capture_output=True, check=False).returncode \
        else ["docker-compose"]
    return run(*tool, "-f", file, "-p", PROJECT, *words, env={**os.environ, "COMPOSE_PROJECT_NAME": PROJECT})


def container(service):
    return run("docker", "ps", "-aq", "--filter", f"label=com.docker.compose.project={PROJECT}",
               "--filter", f"label=com.docker.compose.service={service}").split()[0]


def wait(what, condition):
    deadline, last = time.monotonic() + PATIENCE, None
    while time.monotonic() < deadline:
        try:
            last = condition()
            if last:
                return last
        except Exception as error:  # noqa: BLE001: whatever is not up yet fails in its own way
            last = error
        time.sleep(1)
    sys.exit(f"FAILED: not within {PATIENCE} s: {what}; last: {last}")


@functools.cache
def authority():
    """The certificate of the keys that were made, with which the page's is checked."""
    words = ["docker", "cp", f"{container('keys')}:/keys/authority.pem", "-"]
    copied = subprocess.run(words, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(copied)) as archive:
        return ssl.create_default_context(cadata=archive.extractfile("authority.pem").read().decode())


def page():
    """The snapshot of the page, by the address that it prints."""
    url = re.findall(r"https://\S+", run("docker", "logs", container("pitwall")))[-1]
    base, token = url.split("/?token=")
    request = urllib.request.Request(f"{base}/snapshot", headers={"Cookie": f"pitwall={token}"})
    with urllib.request.urlopen(request, timeout=5, context=authority()) as reply:
        return json.load(reply)


def green():
    cars = page()["cars"]
    return len(cars) == 3 and all(car["state"] == "LOCALIZED" and not car["blind"] for car in cars)


def running(service):
    state = json.loads(run("docker", "inspect", container(service)))[0]["State"]
    health = state.get("Health", {}).get("Status", "healthy")
    return state["Running"] and health == "healthy"


def check(folder):
    car_node, pitwall = sys.argv[1:3]
    daemon = Daemon(folder)
    try:
        if subprocess.run(["docker", "compose", "version"], capture_output=True, check=False).returncode and \
                not shutil.which("docker-compose"):
            skip("no docker-compose")
        image("synpf/car-node", car_node)
        image("synpf/pitwall", pitwall)
        began = time.monotonic()
        compose("up", "-d", "--no-build")
        wait("three green cars in the page", green)
        print(f"three green cars after {time.monotonic() - began:.0f} s")
        for service in SERVICES:
            wait(f"{service} is healthy", lambda service=service: running(service))

        def all_localized():
            cars = run("docker", "exec", container("pitwall"), "/usr/local/bin/pitwall", "cars", "--json",
                       "--keys", "/keys/pit.keys", "--connect", "tls/router:7447")
            return [car["state"] for car in json.loads(cars)] == ["LOCALIZED"] * 3

        wait("three localized cars by the command line", all_localized)
        for service in SERVICES:
            before = json.loads(run("docker", "inspect", container(service)))[0]["State"]["StartedAt"]
            run("docker", "kill", container(service))
            began = time.monotonic()
            wait(f"{service} is back", lambda service=service, before=before: running(service) and json.loads(
                run("docker", "inspect", container(service)))[0]["State"]["StartedAt"] != before)
            wait(f"three green cars after {service} was killed", green)
            print(f"{service}: killed, all green again after {time.monotonic() - began:.0f} s")
        for service in SERVICES:
            assert "PRIVATE KEY" not in run("docker", "logs", container(service)), service
        compose("down", "-v", "-t", "3")
        halls(car_node, pitwall, folder)
    finally:
        with contextlib.suppress(Exception):
            compose("down", "-v", "-t", "3")
        daemon.stop()


def main():
    with tempfile.TemporaryDirectory() as folder:
        check(folder)


if __name__ == "__main__":
    main()
