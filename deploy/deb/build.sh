#!/usr/bin/env bash
# Build the Debian package: deploy/deb/build.sh [FOLDER]; its name is printed. The same commit gives the same bytes.
# An environment from the hash-locked list lies inside (docs/decisions/0018-packages.md). Needs python3-venv, no rights.
# LOCK=centre takes that list: with what a centre, cohorts and the other extras need.
set -euo pipefail
target=$(realpath -m "${1:-dist}")
cd "$(dirname "$0")/../.."
version=$(sed -n 's/^version = "\(.*\)"$/\1/p' pyproject.toml)
architecture=$(dpkg --print-architecture)
home=/usr/lib/stimrig/venv
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
umask 022

say() { printf '[deb] %s\n' "$*" >&2; }
put() { install -D -m 0644 "$1" "$root$2"; }

environment() { # as `python3 -m venv` and pip make it, then without what names this machine
  local venv=$root$home
  say "environment from requirements/${LOCK:-run}.txt"
  /usr/bin/python3 -m venv "$venv"
  "$venv/bin/python" -m pip install -q --disable-pip-version-check --no-compile --require-hashes -r "requirements/${LOCK:-run}.txt"
  "$venv/bin/python" -m pip install -q --disable-pip-version-check --no-compile --no-deps --no-build-isolation .
  SOURCE_DATE_EPOCH=$("$venv/bin/python" -c 'import sys; sys.path.insert(0, "deploy"); import backend; print(backend.commit_time_s())')
  export SOURCE_DATE_EPOCH
  python=$("$venv/bin/python" -c 'import sys; print("{}.{}".format(*sys.version_info))')
  "$venv/bin/python" -m pip uninstall -q -y setuptools pip
  find "$venv/bin" -type f ! -name stimrig -delete
  sed -i "1s|^#!.*|#!$home/bin/python3|" "$venv/bin/stimrig"
  printf 'home = /usr/bin\ninclude-system-site-packages = false\n' >"$venv/pyvenv.cfg"
  rm -rf "$venv/include" "$venv/share" "$venv"/lib/*/site-packages/{distutils-precedence.pth,_distutils_hack}
  # What pip keeps to uninstall: dpkg does that here. Tests of others' packages are not needed.
  find "$venv" \( -path '*.dist-info/RECORD' -o -path '*.dist-info/INSTALLER' -o -path '*.dist-info/REQUESTED' \
    -o -path '*.dist-info/direct_url.json' \) -delete
  find "$venv" -type d \( -name __pycache__ -o -path '*/site-packages/*/tests' \) -prune -exec rm -rf {} +
}

files() {
  local path
  mkdir -p "$root/usr/bin"
  ln -s ../lib/stimrig/venv/bin/stimrig "$root/usr/bin/stimrig"
  for path in deploy/systemd/*.service deploy/systemd/*.timer; do put "$path" "/usr/lib/systemd/system/${path##*/}"; done
  put deploy/systemd/stimrig.sysusers.conf /usr/lib/sysusers.d/stimrig.conf
  put deploy/systemd/stimrig.tmpfiles.conf /usr/lib/tmpfiles.d/stimrig.conf
  put deploy/udev/70-stimrig.rules /usr/lib/udev/rules.d/70-stimrig.rules
  put deploy/rig.example.toml /usr/share/stimrig/rig.example.toml
  for path in deploy/monitoring/*; do put "$path" "/usr/share/stimrig/monitoring/${path##*/}"; done
  put deploy/deb/lintian-overrides /usr/share/lintian/overrides/stimrig
  put deploy/deb/copyright /usr/share/doc/stimrig/copyright
  for path in deploy/nginx/*.conf; do put "$path" "/usr/share/doc/stimrig/examples/${path##*/}"; done
  for path in README.md docs/*.md docs/safety/*.md docs/decisions/*.md; do put "$path" "/usr/share/doc/stimrig/$path"; done
  printf 'stimrig (%s) stable; urgency=medium\n\n  * %s\n\n -- %s  %s\n' "$version" \
    "See docs/ and the release's notes." "The stimrig authors <maintainers@localhost>" \
    "$(date -u -R -d "@$SOURCE_DATE_EPOCH")" | gzip -9n >"$root/usr/share/doc/stimrig/changelog.gz"
}

control() {
  mkdir "$root/DEBIAN"
  install -m 0755 deploy/deb/{preinst,postinst,prerm,postrm} "$root/DEBIAN/"
  sed -e "s/@VERSION@/$version/; s/@ARCHITECTURE@/$architecture/; s/@PYTHON@/$python/; s/@NEXT@/3.$((${python#3.} + 1))/" \
    -e "s/@SIZE@/$(du -sk --apparent-size "$root/usr" | cut -f1)/" deploy/deb/control >"$root/DEBIAN/control"
  (cd "$root" && find usr -type f -print0 | LC_ALL=C sort -z | xargs -0 md5sum) >"$root/DEBIAN/md5sums"
}

environment
files
control
chmod -R u=rwX,go=rX "$root"
find "$root" -type f -name "*.so*" -exec chmod a-x {} +
find "$root" -exec touch -h -d "@$SOURCE_DATE_EPOCH" {} +
mkdir -p "$target"
say "packing"
dpkg-deb --root-owner-group --threads-max=2 -Zzstd -z12 --build "$root" "$target/stimrig_${version}_$architecture.deb" >&2
echo "$target/stimrig_${version}_$architecture.deb"
