# tests/bench/stability_joint.gp - draws stability_joint.c's CSV. Usage: gnuplot -e "out='build/stability/joint'" tests/bench/stability_joint.gp
# A chart per axis: the distance error (median of the runs; left), and of all runs the share that succeeds and that fails without a word (right).
set datafile separator ","
csv = out.".csv"
single = "start_m w_sim rotation_deg centre_m noise_percent camera_px bumps_mm roughness_mm views gain_percent gain_solved_percent clipped_percent moved_mm"
label = "'first distance of the lights, m (0: swept)' 'last weight of E_{sim}' 'rotation of the start, degrees' 'centre of the start, m' 'noise of a sample, % of white' 'cameras, px' 'geometry: waves, mm' 'geometry: roughness, mm' 'views' 'gain drift, %' 'gain drift, gains solved for, %' 'clipped samples, %' 'object moved in half of the views, mm'"
# of a set, axis and method: value, share of runs with mean < 5 %, with median light < 5 %, dishonest; over runs, the median of the mean and of the median light's error
awk(s, a, m) = sprintf("< awk -F, 'function med(k,  i,j,t,n){n=split(k,v,\" \"); for(i=2;i<=n;i++)for(j=i;j>1&&v[j]<v[j-1];j--){t=v[j];v[j]=v[j-1];v[j-1]=t} return n%%2?v[(n+1)/2]:(v[n/2]+v[n/2+1])/2} \
  $1==\"%s\"&&$2==\"%s\"&&$6==\"%s\"&&$7!=\"error\"{x=$3; if(!(x in n)){o[++k]=x} n[x]++; ok[x]+=$11<5; near[x]+=$12<5; bad[x]+=($7==\"dishonest\"); e[x]=e[x]\" \"($11+0>1e4?1e4:$11); f[x]=f[x]\" \"$12} \
  END{for(i=1;i<=k;i++){x=o[i]; print x\",\"100*ok[x]/n[x]\",\"100*near[x]/n[x]\",\"100*bad[x]/n[x]\",\"med(e[x])\",\"med(f[x])}}' %s", s, a, m, csv)
has(s, a, m) = int(system(sprintf("awk -F, '$1==\"%s\"&&$2==\"%s\"&&$6==\"%s\"{n++} END{print n+0}' %s", s, a, m, csv))) > 0
sets = system("awk -F, 'NR>1&&!($1 in s){s[$1]; printf \"%s \", $1}' ".csv)
colour(s) = s eq "D3" ? "#d7191c" : "#2c7bb6"
map(s, m) = sprintf("< awk -F, '$1==\"%s\"&&$2==\"map\"&&$6==\"%s\"&&$7!=\"error\"{k=$3\",\"$4; n[k]++; e[k]+=log($11>0.1?($11<1000?$11:1000):0.1)} END{for(k in n) print k\",\"exp(e[k]/n[k])}' %s | sort -t, -k2,2g -k1,1g", s, m, csv)
headline = system("awk -F, '$2==\"random\"{k=$1\" \"$6; n[k]++; ok[k]+=$11<5; near[k]+=$12<5; bad[k]+=$7==\"dishonest\"} END{for(k in n) printf \"%s: %d of %d (median light: %d; failed and trusted: %d)\\n\", k, ok[k], n[k], near[k], bad[k]}' ".csv)
worse = "missing mirrored"
do for [term in "svg png"] {
    if (term eq "svg") { set terminal svg size 1800,1500 font "sans,11" background "white" } else { set terminal pngcairo size 1800,1500 font "sans,10" }
    set output out.".".term
    set multiplot layout 5,4 title "Stage 1 with its input made worse" font ",13"
    set grid lc "#dddddd"
    do for [i = 1:words(single)] {
        a = word(single, i)
        if (!has(words(sets) > 0 ? word(sets, 1) : "", a, "joint")) { set multiplot next; continue }
        set title word(label, i) offset 0,-.5
        if (a eq "w_sim") { set logscale x; set format x "10^{%L}" } else { unset logscale x; set format x "%g" }
        set logscale y
        set yrange [.5:300]
        set ytics (.5, 1, 2, 5, 10, 20, 50, 100, 200)
        set y2range [-6:106]
        set y2tics 0,50,100
        if (i % 4 == 1) { set ylabel "distance error, %" } else { unset ylabel }
        if (i % 4 == 0) { set y2label "share of runs, %" } else { unset y2label }
        set key off
        plot 5 with lines lc "#999999" dt 2, \
             for [s in sets] awk(s, a, "joint") using 1:5 with linespoints lc rgb colour(s) lw 2 pt 7 ps .7, \
             for [s in sets] awk(s, a, "joint") using 1:6 with lines lc rgb colour(s) dt 3 lw 2, \
             for [s in sets] awk(s, a, "alternating") using 1:5 with linespoints lc rgb colour(s) lw 1 pt 6 ps .7, \
             for [s in sets] awk(s, a, "joint") using 1:2 axes x1y2 with points lc rgb colour(s) pt (s eq "D3" ? 9 : 8) ps 1.2, \
             for [s in sets] awk(s, a, "joint") using 1:4 axes x1y2 with points lc rgb colour(s) pt (s eq "D3" ? 2 : 1) ps 1
    }
    unset y2tics; unset y2label; unset grid
    # a table of what must be doubted
    unset logscale y; set xrange [0:1]; set yrange [0:1]; unset tics; unset border; unset ylabel
    set title "a light gone from the panorama; mirrored" offset 0,-.5
    table = system("awk -F, '$2==\"missing\"||$2==\"mirrored\"{k=$1\" \"$2\" \"$3; if(!(k in n))o[++m]=k; n[k]++; t[k]+=$9; d[k]=$11} END{for(i=1;i<=m;i++)printf \"%s: trusted %d of %d, error %.0f %%\\n\", o[i], t[o[i]], n[o[i]], d[o[i]]}' ".csv)
    set label 1 table at graph 0,.98 left font ",8"
    plot -1 notitle
    unset label 1
    set title "key"
    set label 1 "blue: D2 (albedo given), red: D3\nline, filled: joint, mean over the lights\ndotted: joint, the median light\nline, open: alternating, mean\ndashed: 5 %, the bound of a success\ntriangles: runs that succeed (right)\n+ and x: runs that FAIL AND ARE TRUSTED (right)\nmissing 0-3: a panel, 100: the strongest light\n\nrandom starts below 5 %:\n".headline at graph 0,.98 left font ",9"
    plot -1 notitle
    unset label 1
    set border; set tics; set xtics auto; set ytics auto
    set view map
    set palette defined (0 "#1a9641", .7 "#a6d96a", 1 "#ffffbf", 1.3 "#fdae61", 2.5 "#d7191c")
    set cbrange [0:2.5]; unset colorbox
    set xrange [-2.5:22.5]; set yrange [-.125:1.125]
    set xtics 0,5,20; set ytics 0,.25,1
    do for [s in sets] { do for [m in "joint alternating"] { if (has(s, "map", m)) {
        set title s.", ".m.": error % over rotation, degrees, and centre, m" font ",9"
        plot map(s, m) using 1:2:(log10($3)) with image notitle, map(s, m) using 1:2:(sprintf($3 < 10 ? "%.1f" : "%.0f", $3)) with labels notitle
    } } }
    unset multiplot
    set xrange [*:*]; set yrange [*:*]; set tics; set border
    set xtics auto; set ytics auto
}
