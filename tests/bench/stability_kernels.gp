# tests/bench/stability_kernels.gp - draws stability_kernels.c's CSV. Usage: gnuplot -e "out='build/stability/kernels'" ...
set datafile separator ","
kernel = system("tail -n 1 ".out.".csv | cut -d, -f1")
set title "float32 shading: largest error per cell, kernel ".kernel." against double (log10, relative)"
set xlabel "roughness"
set ylabel "light's elevation above the horizon, degrees"
set view map
set palette defined (-8 "#2c7bb6", -6 "#abd9e9", -4 "#ffffbf", -2 "#d7191c")
set cbrange [-8:-2]
unset key
rows = sprintf("< awk -F, '$1==\"%s\"{if(!($2 in x)){x[$2]=nx++} if(!($3 in y)){y[$3]=ny++} print x[$2]\",\"y[$3]\",\"$5\",\"$2\",\"$3}' %s.csv", kernel, out)
do for [term in "svg png"] {
    if (term eq "svg") { set terminal svg size 900,600 background "white" } else { set terminal pngcairo size 900,600 }
    set output out.".".term
    plot rows using 1:2:(log10($3)):xtic(4):ytic(5) with image, \
         rows using 1:2:(sprintf("%.0e", $3)) with labels font ",9" notitle
}
