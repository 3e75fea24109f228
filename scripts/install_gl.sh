#!/usr/bin/env bash
# Makes sure that MuJoCo can render without a screen: tries what is there, installs Mesa where it may.
# Usage: scripts/install_gl.sh [python that has mujoco]
set -euo pipefail
python=${1:-.venv/bin/python}
packages=(libegl1 libgl1 libgl1-mesa-dri)

[ "$(uname)" = Linux ] || exit 0 # elsewhere the system brings OpenGL

# A real context, since a library that loads may still lack its driver.
can_render() {
    local gl
    for gl in ${MUJOCO_GL:-egl osmesa}; do
        if MUJOCO_GL=$gl "$python" -c 'import mujoco; mujoco.GLContext(64, 32).make_current()' &>/dev/null; then
            return 0
        fi
    done
    return 1
}

give_up() {
    echo "MuJoCo cannot render here$1: install ${packages[*]} (Debian, Ubuntu) or" \
        "mesa-libEGL mesa-dri-drivers (Fedora), then run make again" >&2
    exit 1
}

can_render && exit
command -v apt-get >/dev/null || give_up ""
if [ "$(id -u)" = 0 ]; then
    sudo=()
elif sudo -n true 2>/dev/null; then
    sudo=(sudo -n)
else
    give_up " and installing needs root"
fi

echo "MuJoCo cannot render yet: installing ${packages[*]}"
"${sudo[@]}" apt-get update -qq &&
    "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends "${packages[@]}" >/dev/null ||
    give_up " and apt-get failed"
can_render || give_up " even with ${packages[*]}${MUJOCO_GL:+ and MUJOCO_GL=$MUJOCO_GL}"
