#!/usr/bin/env bash
# Build and try all that is handed out: `make packages`. Into dist/: wheel, sdist, the Debian package; a container's image.
# What cannot be tried here, for want of a tool or of rights, is named at the end. BASE: the container's Debian.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=$PWD/.venv/bin
left=()
say() { printf '\033[1m[packages]\033[0m %s\n' "$*"; }

say "wheel and sdist, twice, and what an index would say"
rm -rf dist
"$bin/python" -m build --no-isolation -w -s -o dist . >/dev/null
again=$(mktemp -d)
trap 'rm -rf "$again"' EXIT
(umask 077 && "$bin/python" -m build --no-isolation -w -s -o "$again/dist" . >/dev/null)
for path in dist/*; do cmp "$path" "$again/$path"; done
"$bin/check-wheel-contents" dist/*.whl
"$bin/twine" check --strict dist/*

say "the wheel in an environment of its own, with the extra page: one whole test"
python3 -m venv "$again/venv"
grep -E '^[a-z0-9._-]+==' requirements/run.txt | sed 's/ \\$//' >"$again/pins"
"$again/venv/bin/pip" install -q --disable-pip-version-check -c "$again/pins" "$(echo dist/*.whl)[page]"
"$again/venv/bin/stimrig" demo --data "$again/demo" >"$again/demo.txt" || { tail -5 "$again/demo.txt"; exit 1; }

say "Debian package"
deploy/deb/build.sh dist
if command -v lintian >/dev/null; then
  lintian --allow-root --fail-on error dist/*.deb
else
  left+=("lintian is not installed")
fi
if [ "$(id -u)" = 0 ] && [ -n "${TRY_DEB:-}" ]; then
  deploy/deb/try.sh dist/*.deb "$TRY_DEB"
else
  left+=("the package in a bare Debian: TRY_DEB=FOLDER made by debootstrap, as root")
fi

if command -v buildah >/dev/null; then
  say "container"
  buildah build --isolation "${ISOLATION:-oci}" --format docker ${BASE:+--build-arg BASE="$BASE"} -f deploy/Containerfile -t stimrig .
else
  left+=("buildah is not installed: no container")
fi
[ ${#left[@]} -eq 0 ] || { say "not tried:"; printf '  %s\n' "${left[@]}"; }
say "done: $(echo dist/*)"
