# tests/bench/chart_lights.gp - draws chart_lights.c's CSV. Usage: gnuplot -e "out='build/chart/lights'" chart_lights.gp
set datafile separator ","
set logscale xy
set xlabel "CPU microseconds per shaded sample (gather + shade, one core, fastest kernel)"
set ylabel "relative RMSE against 65,536 lights, percent"
set title "What a light costs, and what it buys: N = 16 ... 16,384 directional lights of five softboxes"
set grid
set key outside right
# the fastest kernel is the last one listed
kernel = system("tail -n 1 ".out.".csv | cut -d, -f1")
rough = "0.1 0.2 0.35 0.5 0.7 1"
row(r) = sprintf("< awk -F, '$1==\"%s\" && $3==%s' %s.csv", kernel, r, out)
do for [term in "svg png"] {
    if (term eq "svg") { set terminal svg size 1000,600 background "white" } else { set terminal pngcairo size 1000,600 }
    set output out.".".term
    plot for [r in rough] row(r) using 5:4 with linespoints title "roughness ".r, \
         row("0.35") using 5:4:2 with labels offset 0,1 notitle
}
