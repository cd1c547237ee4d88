#!/usr/bin/env bash
# Install or upgrade stimrig on a Debian machine: users, a locked environment under /opt/stimrig, units, udev rules, settings.
# Idempotent: a second run changes nothing; settings and data that are there are left alone. Starts and restarts nothing.
#   sudo deploy/install.sh [--dry-run] [--can IFACE] [--no-can]
set -euo pipefail
cd "$(dirname "$0")/.."
source_dir=$PWD
prefix=/opt/stimrig
dry=0
can=can0

usage() { sed -n '2,4s/^# \{0,1\}//p' "$source_dir/deploy/install.sh"; }
while [ $# -gt 0 ]; do
  case $1 in
    --dry-run) dry=1 ;;
    --can) [ $# -gt 1 ] || { echo "install.sh: --can needs the name of an interface, e.g. can0" >&2; exit 2; }; can=$2; shift ;;
    --no-can) can= ;;
    -h | --help) usage; exit 0 ;;
    *) echo "install.sh: $1: unknown option (--dry-run, --can IFACE, --no-can, --help)" >&2; exit 2 ;;
  esac
  shift
done

say() { printf '[install] %s\n' "$*"; }
fail() { printf 'install.sh: %s\n' "$*" >&2; exit 1; }
run() { # every change goes through here
  if [ $dry = 1 ]; then say "would: $*"; else "$@"; fi
}

[ -f /etc/debian_version ] || fail "this is no Debian; docs/install.md lists the steps to do by hand"
[ $dry = 1 ] || [ "$(id -u)" -eq 0 ] || fail "run it as root (or with --dry-run)"

packages() { # install what is missing
  local missing=()
  for package in "$@"; do
    dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
  done
  [ ${#missing[@]} -eq 0 ] && return
  say "Debian packages: ${missing[*]}"
  run apt-get update -qq
  run env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}"
}

place() { # place SOURCE TARGET MODE: copy if it differs
  if [ -f "$2" ] && cmp -s "$1" "$2"; then return; fi
  say "$2"
  run install -D -m "$3" -o root -g root "$1" "$2"
}

release() { # an environment named after what is in it; the link is turned once it is complete
  local id target work
  id=$(cd "$source_dir" && find pyproject.toml requirements/run.txt stimrig rig identify api hardware_sim deploy docs \
    -type f ! -path '*/__pycache__/*' ! -path '*.egg-info/*' -print0 | LC_ALL=C sort -z | xargs -0 sha256sum |
    sha256sum | cut -c1-12)
  target=$prefix/releases/$id
  if [ -f "$target/.complete" ]; then
    say "release $id is there"
  else
    say "release $id: environment from requirements/run.txt (a minute or two)"
    run rm -rf "$target"
    run mkdir -p "$target/share"
    run python3 -m venv "$target/venv"
    run "$target/venv/bin/python" -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/run.txt
    if [ $dry = 0 ]; then
      work=$(mktemp -d) # setuptools writes into the folder it builds from
      cp -r pyproject.toml README.md stimrig rig identify api hardware_sim "$work/"
      "$target/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation "$work"
      rm -rf "$work"
      cp -r deploy docs "$target/share/"
      # The services' users cannot write here: what they would compile is compiled now.
      "$target/venv/bin/python" -m compileall -q "$target/venv/lib" || true
      chmod -R go-w,a+rX "$target"
      touch "$target/.complete"
    fi
  fi
  if [ "$(readlink "$prefix/current" 2>/dev/null)" != "releases/$id" ]; then
    say "$prefix/current -> releases/$id (was: $(readlink "$prefix/current" 2>/dev/null || echo nothing))"
    run ln -sfn "releases/$id" "$prefix/current.new"
    run mv -T "$prefix/current.new" "$prefix/current"
    changed=1
  fi
}

settings() { # only where there are none: a person's settings are never touched
  if ! [ -f /etc/stimrig/rig.toml ]; then
    say "/etc/stimrig/rig.toml from the example: edit it for your devices"
    run install -D -m 0640 -o root -g stimrig deploy/rig.example.toml /etc/stimrig/rig.toml
  fi
  if ! [ -f /etc/stimrig/api.env ]; then
    say "/etc/stimrig/api.env with a new administrator's token, readable by root only"
    if [ $dry = 0 ]; then
      (umask 077 && printf '# Settings of stimrig-api, see docs/install.md.\nSTIMRIG_ADMIN_TOKEN=%s\n' \
        "$(python3 -c 'import secrets; print(secrets.token_urlsafe(32))')" >/etc/stimrig/api.env)
    fi
  fi
}

systemd_runs() { [ -d /run/systemd/system ]; }

changed=0
packages python3 python3-venv systemd udev iproute2
if [ $dry = 0 ]; then
  python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || fail "Python 3.11 or later is needed, here is $(python3 -V)"
fi

place deploy/systemd/stimrig.sysusers.conf /usr/lib/sysusers.d/stimrig.conf 0644
run systemd-sysusers /usr/lib/sysusers.d/stimrig.conf
place deploy/systemd/stimrig.tmpfiles.conf /usr/lib/tmpfiles.d/stimrig.conf 0644
run systemd-tmpfiles --create /usr/lib/tmpfiles.d/stimrig.conf
release
settings
for unit in stimrig-rig.service stimrig-api.service stimrig-outbox.service stimrig-centre.service \
  stimrig-can@.service stimrig-backup.service stimrig-backup.timer; do
  place "deploy/systemd/$unit" "/etc/systemd/system/$unit" 0644
done
place deploy/udev/70-stimrig.rules /etc/udev/rules.d/70-stimrig.rules 0644

if systemd_runs; then
  run systemctl daemon-reload
  run udevadm control --reload
else
  say "systemd is not running here: units are enabled, and start at the next boot"
fi
run systemctl --quiet enable stimrig-rig.service stimrig-api.service
[ -z "$can" ] || run systemctl --quiet enable "stimrig-can@$can.service"

if [ $dry = 0 ]; then
  if answer=$("$prefix/current/venv/bin/python" -m stimrig.rig --config /etc/stimrig/rig.toml --check 2>&1); then
    say "rig file: $answer"
  else
    say "rig file needs mending: $answer"
  fi
fi
[ $changed = 0 ] || say "when no test runs: systemctl restart stimrig-rig stimrig-api"
say "done; next: docs/install.md, 'After the installation'"
