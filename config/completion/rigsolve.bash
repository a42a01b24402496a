# bash completion for rigsolve: commands, then each command's own long options as its --help lists them.
_rigsolve() {
    local cur=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD - 1]}
    if [ "$COMP_CWORD" = 1 ]; then
        mapfile -t COMPREPLY < <(compgen -W "$(rigsolve --help | sed -n 's/^  \([a-z]*\) .*/\1/p') --help --version" -- "$cur")
    elif [[ $cur == -* ]]; then
        mapfile -t COMPREPLY < <(compgen -W "$(rigsolve "${COMP_WORDS[1]}" --help 2>/dev/null | grep -oE -- '--[a-z-]+' | sort -u)" -- "$cur")
    elif [ "$before" = --formats ]; then # any of them, with commas between
        mapfile -t COMPREPLY < <(compgen -P "${cur%"${cur##*,}"}" -W "glb mtlx obj blender" -- "${cur##*,}")
    elif [ "$before" = --methods ]; then
        mapfile -t COMPREPLY < <(compgen -P "${cur%"${cur##*,}"}" -W "joint alternating directional" -- "${cur##*,}")
    elif [ "$before" = --kernels ]; then
        mapfile -t COMPREPLY < <(compgen -P "${cur%"${cur##*,}"}" -W "none portable avx2 avx512 reference" -- "${cur##*,}")
    elif [ "$before" = --presets ]; then
        mapfile -t COMPREPLY < <(compgen -P "${cur%"${cur##*,}"}" -W "none preview standard final" -- "${cur##*,}")
    elif [ "${COMP_WORDS[1]}" = chart ]; then # synthetic studios, or takes
        mapfile -t COMPREPLY < <(compgen -W "D3 D4 D5" -- "$cur"; compgen -d -- "$cur")
    elif [ "${COMP_WORDS[1]}" = synth ] && [ "$COMP_CWORD" = 2 ]; then
        mapfile -t COMPREPLY < <(compgen -W "D1 D2 D3 D4 D5" -- "$cur")
    fi
}
complete -o default -F _rigsolve rigsolve
