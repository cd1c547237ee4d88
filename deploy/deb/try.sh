#!/usr/bin/env bash
# The package's whole life in a bare Debian, as root: deploy/deb/try.sh PACKAGE FOLDER, a folder that debootstrap has made.
# Installed, one whole test by a person without rights, installed again, removed, purged. systemd does not run there.
set -euo pipefail
package=$(realpath "$1")
root=$(realpath "$2")
cp "$package" "$root/var/tmp/stimrig.deb"
cp /etc/resolv.conf "$root/etc/"
mountpoint -q "$root/proc" || mount -t proc proc "$root/proc"
mountpoint -q "$root/dev" || mount --rbind /dev "$root/dev"
inside() { env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive chroot "$root" sh -euc "$*"; } # nothing of this machine's
seconds() { local began; began=$(date +%s); "${@:2}" >/dev/null; echo "[try] $1: $(($(date +%s) - began)) s"; }

inside 'apt-get update -qq'
seconds "downloads" inside 'apt-get install -y -qq --no-install-recommends --download-only /var/tmp/stimrig.deb'
seconds "installed" inside 'apt-get install -y -qq --no-install-recommends /var/tmp/stimrig.deb'
inside 'id somebody >/dev/null 2>&1 || useradd -m somebody'
seconds "the demo's report" inside 'su somebody -c "cd && rm -rf var && stimrig demo"'
inside 'su somebody -c "ls ~/var/demo/*/report.html"'
inside 'echo "# mine" >>/etc/stimrig/rig.toml; echo kept >/var/lib/stimrig/rig/recordings/a; cp -p /etc/stimrig/api.env /var/tmp/'
seconds "installed again" inside 'apt-get install -y -qq --reinstall /var/tmp/stimrig.deb'
inside 'tail -1 /etc/stimrig/rig.toml | grep -qx "# mine"; cmp /etc/stimrig/api.env /var/tmp/api.env'
inside 'apt-get remove -y -qq stimrig >/dev/null; test -f /etc/stimrig/rig.toml; test ! -e /usr/lib/stimrig; test ! -e /usr/bin/stimrig'
inside 'apt-get purge -y -qq stimrig; test ! -e /etc/stimrig; test "$(cat /var/lib/stimrig/rig/recordings/a)" = kept'
echo "[try] removed and purged: settings gone, data kept"
