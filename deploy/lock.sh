#!/usr/bin/env bash
# Resolve the locked lists: hashes of every wheel for Python 3.11 and later, no index lines. UPGRADE= keeps every pin that can stay.
set -euo pipefail
cd "$(dirname "$0")/.."
read -ra upgrade <<<"${UPGRADE---upgrade}"
compile() { # name, extras…
  local out=requirements/$1.txt; shift
  local extras=(); for e in "$@"; do extras+=(--extra "$e"); done
  uv pip compile pyproject.toml "${extras[@]}" --universal --python-version 3.11 $hashes \
    --no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet \
    "${upgrade[@]}" "${constraint[@]}" -o "$out"
}
constraint=() hashes=--generate-hashes
compile run build page
pins=$(mktemp); trap 'rm -f "$pins"' EXIT
grep -E '^[a-z0-9_-]+==' requirements/run.txt | sed 's/ \\$//' > "$pins"
constraint=(-c "$pins") # tests run with the very versions that users run
compile test build test
hashes='' compile docs build page docs # pins alone: the site is no part of the product
constraint=() # the peers ask for an older scipy: the bench has an environment of its own
compile bench build page bench
