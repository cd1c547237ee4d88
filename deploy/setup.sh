#!/usr/bin/env bash
# Set up .venv from a hash-locked list: deploy/setup.sh run|test|docs|bench
# Debian packages are installed only where they are missing, and only as root.
set -euo pipefail
cd "$(dirname "$0")/.."
what=$1
venv=.venv
case $what in docs | bench) venv=.venv-$what ;; esac # the peers of bench pin an older scipy

say() { printf '\033[1m[setup]\033[0m %s\n' "$*"; }

debian() { # install Debian packages, as root, only those that are missing
  local missing=()
  for package in "$@"; do
    dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
  done
  [ ${#missing[@]} -eq 0 ] && return 0
  if [ "$(id -u)" -ne 0 ]; then
    say "missing Debian packages: ${missing[*]}. As root: apt-get install ${missing[*]}" >&2
    exit 1
  fi
  say "installing Debian packages: ${missing[*]}"
  apt-get update -qq -o Acquire::http::Timeout=30
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

find_python() { # the first Python of 3.11 or later
  local candidate
  for candidate in python3 python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null 2>&1 &&
      "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      command -v "$candidate"
      return
    fi
  done
}

python=$(find_python)
if [ -z "$python" ]; then
  debian python3 python3-venv
  python=$(find_python)
  [ -n "$python" ] || { say "stimrig needs Python 3.11 or later" >&2; exit 1; }
fi
if ! [ -x $venv/bin/python ]; then
  "$python" -c 'import ensurepip, venv' 2>/dev/null || debian python3-venv
  say "virtual environment in $venv ($("$python" --version))"
  "$python" -m venv $venv
fi

say "installing the locked list requirements/$what.txt (the first time takes a minute or two)"
hashes=--require-hashes
[ "$what" = docs ] && hashes=''
$venv/bin/python -m pip install --quiet --disable-pip-version-check $hashes -r "requirements/$what.txt"
$venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .

if [ "$what" != docs ]; then
  say "compiling, once (half a minute)"
  $venv/bin/python -m stimrig.identify.diagnosis.warm_up
fi

shell=chromium-headless-shell # opens no windows: with the whole browser each tab costs three times the processor
if [ "$what" = test ] && ! command -v $shell >/dev/null 2>&1; then
  if command -v chromium >/dev/null 2>&1; then
    (debian $shell) || say "the pages are tested with the whole chromium: slower, nothing else"
  else
    debian $shell
  fi
fi
if [ "$what" = test ] && ! compgen -G '/usr/lib/postgresql/*/bin/postgres' >/dev/null; then
  debian postgresql
fi
touch "$venv/.$what"
# The list of tests holds the run list.
if [ "$what" = test ]; then touch "$venv/.run"; fi
say "ready"
