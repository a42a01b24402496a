# tests/bench/figure5.gp - draws figure5.c's CSV. Usage: gnuplot -e "out='build/figure5/figure5'" tests/bench/figure5.gp
set datafile separator ","
residuals = system("awk -F, '$2==\"alternating\" && $4==\"1e-06\" { print $5 / $4; exit }' ".out.".csv") + 0
set logscale xy
set logscale x2
set format x "10^{%T}"
set format x2 "10^{%T}"
set format y "%g"
set xrange [1e-14:1]
set x2range [1e-14 * residuals:residuals]
set xtics nomirror 1e-14,100
set x2tics 1e-9,100
set yrange [1:2000]
set grid
set ylabel "error of the distances, percent (mean, by the lights' energy)"
set key top right
starts = "'1 m' truth '2 m'"
curve(n, start) = sprintf("< awk -F, '$1==%s && $2==\"alternating\" && $3==\"%s\"' %s.csv", n, start, out)
level(n, start) = sprintf("< awk -F, '$1==%s && $2==\"joint\" && $3==\"%s\" { print \"1e-14,\" $6; print \"1,\" $6 }' %s.csv", n, start, out)
do for [term in "svg png"] {
    if (term eq "svg") { set terminal svg size 1500,560 background "white" } else { set terminal pngcairo size 1500,560 }
    set output out.".".term
    set multiplot layout 1,3 title "D1, 256 lights solved for: error against w\\_sim, from three starts (below: beside the mean of squares; above: beside their sum)"
    do for [n in "256 512 65536"] {
        set title n." true lights"
        plot for [i=1:3] curve(n, word(starts, i)) using 4:6 with linespoints lc i pt i title "paper, from ".word(starts, i), \
             for [i=1:3] level(n, word(starts, i)) using 1:2 with lines lc i lw 7-2*i title "joint, from ".word(starts, i)
    }
    unset multiplot
}
