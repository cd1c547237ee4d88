#!/usr/bin/env bash
# Install or upgrade stimrig on this Debian machine from this checkout. docs/install.md lists what it puts where.
#   sudo deploy/install.sh [--dry-run]
set -euo pipefail
cd "$(dirname "$0")/.."
dry=0
case ${1:-} in
  '') ;;
  --dry-run) dry=1 ;;
  -h | --help) sed -n '2,3s/^# \{0,1\}//p' deploy/install.sh; exit 0 ;;
  *) echo "install.sh: $1: unknown option (--dry-run, --help)" >&2; exit 2 ;;
esac

fail() { printf 'install.sh: %s\n' "$*" >&2; exit 1; }
run() { # every change goes through here
  if [ $dry = 1 ]; then echo "would: $*"; else "$@"; fi
}
put() { run install -D -m 0644 "$1" "$2"; }

[ -f /etc/debian_version ] || fail "this is no Debian; docs/install.md lists other ways"
[ $dry = 1 ] || [ "$(id -u)" -eq 0 ] || fail "run it as root (or with --dry-run)"
if systemctl --quiet is-active stimrig-rig.service && grep -qs '"running"' /var/lib/stimrig/rig/latch.json; then
  fail "a test runs: end it, or systemctl stop stimrig-rig, then run this again"
fi
umask 022
venv=/usr/lib/stimrig/venv
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

run env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends iproute2 python3-venv
started=$(systemctl list-units --plain --no-legend --state=active 'stimrig-*.service' 2>/dev/null | cut -d' ' -f1 | grep -v '^stimrig-can@' || true)
[ -z "$started" ] || run systemctl stop $started
run python3 -m venv "$venv"
run "$venv/bin/python3" -m pip install -q --disable-pip-version-check --require-hashes -r "requirements/run.txt"
cp -rL stimrig pyproject.toml README.md LICENSE "$work" # the links in stimrig/ become folders
run "$venv/bin/python3" -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation --force-reinstall "$work"
run ln -sfn "$venv/bin/stimrig" /usr/local/bin/stimrig

for path in deploy/systemd/*.service deploy/systemd/*.timer; do put "$path" "/etc/systemd/system/${path##*/}"; done
put deploy/systemd/stimrig.sysusers.conf /etc/sysusers.d/stimrig.conf
put deploy/systemd/stimrig.tmpfiles.conf /etc/tmpfiles.d/stimrig.conf
put deploy/udev/70-stimrig.rules /etc/udev/rules.d/70-stimrig.rules
run systemd-sysusers /etc/sysusers.d/stimrig.conf
run systemd-tmpfiles --create /etc/tmpfiles.d/stimrig.conf
[ -e /etc/stimrig/rig.toml ] || run install -m 0640 -g stimrig deploy/rig.example.toml /etc/stimrig/rig.toml
if ! [ -e /etc/stimrig/api.env ]; then # with a new administrator's token, readable by root only
  (umask 077 && printf 'STIMRIG_ADMIN_TOKEN=%s\n' "$(python3 -c 'import secrets; print(secrets.token_urlsafe(32))')" >"$work/api.env")
  run install -m 0600 "$work/api.env" /etc/stimrig/api.env
fi
run systemctl daemon-reload
run udevadm control --reload
run systemctl enable stimrig-rig.service stimrig-api.service
[ -z "$started" ] || run systemctl start $started
echo "done; next: docs/install.md, 'After the installation'"
