#!/usr/bin/env bash
# Install or upgrade stimrig on this Debian machine from this checkout: build the package, and give it to apt.
# What it does there, and what it leaves alone: docs/install.md. A second run of the same commit changes nothing.
#   sudo deploy/install.sh [--dry-run]
set -euo pipefail
cd "$(dirname "$0")/.."
dry=0
case ${1:-} in
  '') ;;
  --dry-run) dry=1 ;;
  -h | --help) sed -n '2,4s/^# \{0,1\}//p' deploy/install.sh; exit 0 ;;
  *) echo "install.sh: $1: unknown option (--dry-run, --help)" >&2; exit 2 ;;
esac

say() { printf '[install] %s\n' "$*"; }
fail() { printf 'install.sh: %s\n' "$*" >&2; exit 1; }
run() { # every change goes through here
  if [ $dry = 1 ]; then say "would: $*"; else "$@"; fi
}

[ -f /etc/debian_version ] || fail "this is no Debian; docs/install.md lists other ways"
[ $dry = 1 ] || [ "$(id -u)" -eq 0 ] || fail "run it as root (or with --dry-run)"
version=$(sed -n 's/^version = "\(.*\)"$/\1/p' pyproject.toml)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
chmod 755 "$work" # apt reads the package as a user of its own

if ! dpkg-query -W -f='${Status}' python3-venv 2>/dev/null | grep -q 'ok installed'; then
  run apt-get update -qq
  run env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends python3-venv
fi
say "package stimrig $version (a minute or two)"
run deploy/deb/build.sh "$work"
run env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$work/stimrig_${version}_$(dpkg --print-architecture).deb"
say "done; next: docs/install.md, 'After the installation'"
