# bash completion for rigctl: its commands, then what the daemon knows: cameras, takes. A daemon that does not answer completes nothing.
_rigctl_ask() { # command, key: the values of that key in its JSON
    local socket=() i
    for ((i = 1; i < ${#COMP_WORDS[@]}; i++)); do
        [[ ${COMP_WORDS[i]} == --socket ]] && socket=(--socket "${COMP_WORDS[i + 1]}")
    done
    timeout 1 rigctl "${socket[@]}" --json "$1" 2>/dev/null | grep -oE "\"$2\": *\"[^\"]*\"" | sed 's/.*"\([^"]*\)"$/\1/'
}
_rigctl() {
    local cur=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD - 1]} command='' i
    COMPREPLY=()
    [[ $before == --socket || $before == --name || $before == --shots ]] && return
    for ((i = 1; i < COMP_CWORD; i++)); do
        case ${COMP_WORDS[i]} in
        --socket) ((i++)) ;;
        -*) ;;
        *) command=${COMP_WORDS[i]} && break ;;
        esac
    done
    case $command in
    '') mapfile -t COMPREPLY < <(compgen -W "status doctor preflight capture continue cancel takes report process preview resume export calibrate identify reinstate metrics events \
        panorama develop --socket --json --help --version" -- "$cur") ;;
    calibrate) mapfile -t COMPREPLY < <(compgen -W "lag colour --shots --patch --chart --places --reference --check --flat -o" -- "$cur") ;;
    identify) mapfile -t COMPREPLY < <(compgen -W "$(_rigctl_ask status name) board" -- "$cur") ;;
    reinstate) mapfile -t COMPREPLY < <(compgen -W "$(_rigctl_ask status name)" -- "$cur") ;;
    process)
        if [[ $before == --again ]]; then
            mapfile -t COMPREPLY < <(compgen -W "sheet develop panorama reconstruct preview focus standard final" -- "$cur")
        else
            mapfile -t COMPREPLY < <(compgen -W "$(_rigctl_ask takes id) --again --cancel --watch" -- "$cur")
        fi ;;
    report) mapfile -t COMPREPLY < <(compgen -W "$(_rigctl_ask takes id) --open" -- "$cur") ;;
    preview | resume | export) mapfile -t COMPREPLY < <(compgen -W "$(_rigctl_ask takes id)" -- "$cur") ;;
    status) mapfile -t COMPREPLY < <(compgen -W "--watch" -- "$cur") ;;
    panorama) [[ $before == --merge ]] && mapfile -t COMPREPLY < <(compgen -f -W "$(_rigctl_ask takes id)" -- "$cur") ||
        mapfile -t COMPREPLY < <(compgen -W "--name --merge -o --json" -- "$cur") ;;
    capture) mapfile -t COMPREPLY < <(compgen -W "--name --without-missing" -- "$cur") ;;
    develop) [[ $cur == -* ]] && mapfile -t COMPREPLY < <(compgen -W "-o --tiff --half --bilinear --ahd --flat --colour --reference-exposure --exposure --saturation \
        --model --jobs --force --json" -- "$cur") ;;
    esac
}
complete -o default -F _rigctl rigctl
