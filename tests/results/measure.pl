#!/usr/bin/perl
# tests/results/measure.pl - what was promised and what is measured: runs commands, reads their figures, writes figures.csv and README.md.
#   measure.pl                the runs of targets.txt that are cheap: CHEAP_CPU_S processor seconds each, or less
#   measure.pl all            all of them
#   measure.pl S4 lag ...     what these targets, or these runs, need
#   measure.pl read [RUN...]  nothing is run: the logs that are there are read again; what no log tells of stays
#   measure.pl page           only README.md is written again
# Run from the repository root, after make. What a command printed is kept in build/results/RUN.log. A figure comes into figures.csv from such
# a log and in no other way; where a command fails or no figure is found in what it printed, the old row stays and says so. Targets
# without a measurement of their own have the figure of an earlier note, if there is one, and are marked so.
use strict;
use warnings;
use POSIX qw(strftime);

use constant CHEAP_CPU_S => 60;
my ($here, $logs) = ('tests/results', 'build/results');
my @columns = qw(id target figure unit met command commit date cpu_s peak_rss_mb method seed size note);
-f "$here/targets.txt" or die "measure.pl: no $here/targets.txt: run it from the repository root\n";

# ---- the hand-written file ------------------------------------------------------------------------------------------------

my (%run, %target, @runs, @targets);
{
    open(my $f, '<', "$here/targets.txt") or die;
    my ($at, $key);
    while (<$f>) {
        chomp;
        next if /^#/;
        if (/^(run|target) (\S+)$/) {
            my $all = $1 eq 'run' ? \%run : \%target;
            die "targets.txt:$.: $2 is there twice\n" if $all->{$2};
            push @{$1 eq 'run' ? \@runs : \@targets}, $2;
            ($at, $key) = ($all->{$2} = { id => $2 }, undef);
        } elsif (/^([a-z]+): (.+)$/ && $at) {
            $at->{$key = $1} = $2;
        } elsif (/^ +(.+)$/ && $key) {
            $at->{$key} .= " $1";
        } elsif (/\S/) {
            die "targets.txt:$.: expected 'run NAME', 'target ID', 'key: value' or a line that begins with blanks: $_\n";
        }
    }
    for (map { $target{$_} } @targets) {
        die "targets.txt: $_->{id}: no run $_->{run}\n" if $_->{run} && !$run{$_->{run}};
        die "targets.txt: $_->{id}: expected 'bound: <= 2.5', or >=, =\n" if $_->{bound} !~ /^(<=|>=|=) -?[\d.e+-]+$/;
        die "targets.txt: $_->{id}: counts what run $_->{run} prints, which has no 'proof: /REGEX/' that it came to its end\n" if $_->{run} && $_->{parse} =~ /^count/ && !$run{$_->{run}}{proof};
        die "targets.txt: $_->{id}: expected 'parse: max|min|last|count /REGEX/'\n" if $_->{run} && $_->{parse} !~ m{^(max|min|last|count) /.+/$};
    }
}

# ---- measuring ---------------------------------------------------------------------------------------------------------------

sub said { my ($command) = @_; my $s = `$command`; chomp $s; $s }

sub measure {
    my ($r) = @_;
    mkdir 'build'; mkdir $logs;
    my $log = "$logs/$r->{id}";
    unlink "$log.log", "$log.meta";
    if ($r->{make} && system("nice -n 5 make -s $r->{make} >$log.log 2>&1")) {
        print "measure: $r->{id}: make $r->{make} failed: $log.log\n";
        return;
    }
    my ($commit, $date) = (said('git rev-parse --short=7 HEAD') . (said("git status --porcelain --untracked-files=no -- . ':!$here'") ne '' ? '-dirty' : ''), strftime('%F %H:%M', localtime));
    print "measure: $r->{id}, some $r->{cost} s of processor: $r->{command}\n";
    my $began = time;
    open(my $script, '>', "$log.sh") or die "$log.sh: $!\n";
    print $script "$r->{command}\n";
    close $script;
    my $rc = system("/usr/bin/time -o $log.time -f '%U %S %M' sh $log.sh >$log.log 2>&1 </dev/null") >> 8;
    open(my $t, '<', "$log.time") or die "measure.pl: no $log.time: is Debian's package time there?\n";
    my ($user, $system, $kb) = do { my @l = <$t>; split ' ', $l[-1] };
    open(my $m, '>', "$log.meta") or die "$log.meta: $!\n";
    printf $m "rc=%d commit=%s date=%s cpu=%.1f rss=%.1f\n", $rc, $commit, $date, $user + $system, $kb / 1024;
    printf "measure: %s: exit status %d, %.0f s of processor, %d s by the clock\n", $r->{id}, $rc, $user + $system, time - $began;
}

sub shown { my ($figure) = @_; $figure =~ /[.]\d{5}/ ? sprintf('%.4g', $figure) : $figure }

# The figure in a log; undef: it is not there.
sub figure {
    my ($text, $parse) = @_;
    my ($how, $regex) = $parse =~ m{^(\w+) /(.+)/$};
    my @found = $text =~ /$regex/mg;
    return scalar @found if $how eq 'count';
    return if !@found;
    my @sorted = sort { $a <=> $b } @found;
    return $how eq 'max' ? $sorted[-1] : $how eq 'min' ? $sorted[0] : $found[-1];
}

sub met {
    my ($t, $figure) = @_;
    my ($sign, $bound) = split ' ', $t->{bound};
    my $good = $sign eq '<=' ? $figure <= $bound : $sign eq '>=' ? $figure >= $bound : $figure == $bound;
    return $good ? $t->{partly} ? 'partly' : 'yes' : 'no';
}

# ---- figures.csv -----------------------------------------------------------------------------------------------------------

my %row;
sub read_figures {
    %row = ();
    open(my $f, '<', "$here/figures.csv") or return;
    my @names = split /,/, (<$f> // '') =~ s/\n//r;
    while (<$f>) {
        chomp;
        my @v;
        push @v, defined $1 ? $1 =~ s/""/"/gr : $2 while /\G(?:"((?:[^"]|"")*)"|([^,]*))(?:,|$)/gc && @v < @names;
        my %r;
        @r{@names} = map { $_ // '' } @v;
        $row{$r{id}} = \%r;
    }
}

sub write_figures {
    open(my $f, '>', "$here/figures.csv.part") or die "$here/figures.csv.part: $!\n";
    print $f join(',', @columns), "\n";
    for my $id (grep { $row{$_} } @targets) {
        print $f join(',', map { my $v = $row{$id}{$_} // ''; $v =~ /[",]/ ? '"' . $v =~ s/"/""/gr . '"' : $v } @columns), "\n";
    }
    close $f or die "$here/figures.csv.part: $!\n";
    rename "$here/figures.csv.part", "$here/figures.csv" or die "$here/figures.csv: $!\n";
}

sub read_log {
    my ($r) = @_;
    my (%m, $text);
    if (open(my $f, '<', "$logs/$r->{id}.meta")) {
        %m = (<$f> // '') =~ /(rc|commit|date|cpu|rss)=(\S+(?: \d\d:\d\d)?)/g;
    }
    if (open(my $f, '<', "$logs/$r->{id}.log")) { local $/; $text = <$f> }
    for my $t (grep { ($_->{run} // '') eq $r->{id} } map { $target{$_} } @targets) {
        # A bench that finds a promise broken ends with 1 and has its figures all the same.
        my ($proof) = ($r->{proof} // '') =~ m{^/(.+)/$}; # that it came to its end: what is counted may well not be there
        my $figure = defined $text && %m && $m{rc} <= ($r->{fails} // 0) && (!defined $proof || $text =~ /$proof/m) ? figure($text, $t->{parse}) : undef;
        my $text_of_target = "$t->{what}: $t->{bound}" . ($t->{unit} ? " $t->{unit}" : '');
        if (!defined $figure) {
            my $why = %m ? $m{rc} <= ($r->{fails} // 0) ? 'no such figure in what the command printed' : "exit status $m{rc}" : 'could not be built or started';
            print "measure: $t->{id} ($r->{id}): $why: the old row stays\n";
            my $old = $row{$t->{id}} //= { id => $t->{id}, target => $text_of_target, figure => '', met => 'not measured', unit => $t->{unit} // '' };
            $old->{note} = join '; ', grep { length } ($old->{note} // '') =~ s/(?:; )?measurement failed [^;]*//r, 'measurement failed ' . strftime('%F', localtime) . ": $why";
            next;
        }
        $row{$t->{id}} = { id => $t->{id}, target => $text_of_target, figure => $figure + 0, unit => $t->{unit} // '', met => met($t, $figure), command => $r->{command}, commit => $m{commit},
            date => $m{date}, cpu_s => $m{cpu}, peak_rss_mb => $m{rss}, (map { ($_ => $t->{$_} // $r->{$_} // '') } qw(method seed size)), note => $t->{partly} // '' };
    }
}

# Targets that were not measured here, from the notes of earlier sessions or not at all.
sub fill_in {
    for my $t (map { $target{$_} } @targets) {
        my $old = $row{$t->{id}};
        if ($old && $old->{date} && $old->{met} ne 'not measured' && $old->{note} !~ /^note of/) { # the bound or the words may have changed
            $old->{met} = met($t, $old->{figure});
            $old->{target} = "$t->{what}: $t->{bound}" . ($t->{unit} ? " $t->{unit}" : '');
            $old->{note} = join '; ', grep { length } $t->{partly} // '', $old->{note} =~ /(measurement failed [^;]*)/;
            next;
        }
        my $failed = $old && $old->{note} =~ /(measurement failed [^;]*)/ ? $1 : '';
        my %r = (id => $t->{id}, target => "$t->{what}: $t->{bound}" . ($t->{unit} ? " $t->{unit}" : ''), unit => $t->{unit} // '', figure => '', met => 'not measured', note => $failed);
        if ($t->{earlier}) {
            my ($figure, $date, $commit, $command, $note) = split /\s*\|\s*/, $t->{earlier}, 5;
            %r = (%r, figure => $figure + 0, met => met($t, $figure), date => $date, commit => $commit, command => $command,
                (map { ($_ => $t->{$_} // '') } qw(method seed size)), note => join '; ', grep { length } "note of $date, commit $commit, not repeated", $note // '', $t->{partly} // '', $failed);
        }
        $row{$t->{id}} = \%r;
    }
}

# ---- README.md -------------------------------------------------------------------------------------------------------------

sub cell { my ($text) = @_; $text =~ s/\|/\\|/gr }

sub write_page {
    my %count;
    $count{$row{$_}{met}}++ for @targets;
    my ($model, $isa) = ('processor unknown', '');
    if (open(my $f, '<', '/proc/cpuinfo')) { local $/; my $t = <$f>; $model = $1 if $t =~ /^model name\s*: (.*)$/m; $isa = $t =~ /\bavx512f\b/ ? ', AVX-512' : '' }
    my $debian = -f '/etc/debian_version' ? 'Debian ' . said('cat /etc/debian_version') : 'no Debian';
    open(my $p, '>', "$here/README.md.part") or die "$here/README.md.part: $!\n";
    my $n_notes = grep { $row{$_}{note} =~ /^note of/ } @targets;
    my $n_runs = @targets - $n_notes - ($count{'not measured'} // 0);
    print $p <<"";
<!-- written by tests/results/measure.pl out of figures.csv and targets.txt: change those -->
# Results
Every target of the solver and of the rig, and what is measured. `make results` runs what is cheap, `RESULTS=all make results` everything, `RESULTS="S4 lag"` what is
named; each figure comes out of what the command of its row printed, with its commit, and none is entered by hand ([figures.csv](figures.csv): also processor
seconds, peak memory, seed and size; [targets.txt](targets.txt): targets, commands, reasons). Rows marked *note* are of earlier sessions' notes, by the commands
and commits they name (a note says the session; the commit is the newest of that time), and were **not repeated**. A commit with "-dirty" had changes that were not committed yet.
\nMachine of this page: @{[said('nproc')]} cores ($model$isa), $debian, shared with other jobs: wall times are noise, processor seconds (CPU s) count. No real camera, board or raw file was
there: the rig is simulated, the board is its real image in simavr.
\n**@{[$count{yes} // 0]} met, @{[$count{partly} // 0]} met in part, @{[$count{no} // 0]} missed, @{[$count{'not measured'} // 0]} not measured**, of @{[scalar @targets]}: $n_runs by runs that figures.csv records, $n_notes by notes.

    if (my @pages = grep { -f "$here/$_->[0]" } ['chart.png', 'seconds against error, solver and peers'], ['chart.csv', 'the same as numbers'], ['studios.csv', 'what the whole chain loses of each studio, stage by stage']) {
        print $p "\nBeside this page: ", join('; ', map { "[$_->[0]]($_->[0]): $_->[1]" } @pages), ".\n";
    }
    my $section = '';
    for my $t (map { $target{$_} } @targets) {
        my $r = $row{$t->{id}};
        if ($t->{of} && $t->{of} ne $section) {
            $section = $t->{of};
            print $p "\n## $section\n| id | target | figure | met | CPU s | measured by |\n|---|---|---|---|---|---|\n";
        }
        my $when = !$r->{date} ? '' : $r->{note} =~ /^note of/ ? " (*note*, $r->{date}, $r->{commit})" : " ($r->{date}, $r->{commit})";
        print $p '| ', join(' | ', $t->{id}, cell($r->{target}), $r->{figure} eq '' ? '-' : shown($r->{figure}) . " $r->{unit}", $r->{met} eq 'no' ? '**no**' : $r->{met}, $r->{cpu_s} // '',
            ($r->{command} // '') ne '' ? '`' . cell($r->{command}) . "`$when" : cell($t->{why} // '')), " |\n";
    }
    for (['no', 'Missed'], ['partly', 'Met in part'], ['not measured', 'Not measured']) {
        my ($met, $title) = @$_;
        my @those = grep { $row{$_}{met} eq $met } @targets or next;
        print $p "\n## $title\n";
        for my $t (map { $target{$_} } @those) {
            my $r = $row{$t->{id}};
            print $p "- **$t->{id}** $t->{what}", $r->{figure} eq '' ? '.' : ' (' . shown($r->{figure}) . " $r->{unit}, wanted $t->{bound})." =~ s/ ,/,/r, join('', map { my $s = $_ =~ s/([^.])$/$1./r; " \u$s" } grep { length }
                $met eq 'partly' ? $t->{partly} : '', $t->{why} // ''), $t->{next} ? " *Next:* $t->{next}" : '', "\n";
        }
    }
    if (my @said = grep { $row{$_}{met} eq 'yes' && $target{$_}{why} } @targets) {
        print $p "\n## Remarks\n";
        print $p "- **$_** $target{$_}{why}\n" for @said;
    }
    if (my @failed = grep { $row{$_}{note} =~ /measurement failed/ } @targets) {
        print $p "\n## Failed measurements\n";
        print $p "- **$_**: $row{$_}{note}\n" for @failed;
    }
    close $p or die;
    rename "$here/README.md.part", "$here/README.md" or die "$here/README.md: $!\n";
    print "measure: $here/README.md: ", join(', ', map { "$count{$_} $_" } sort keys %count), "\n";
}

# ---- which ------------------------------------------------------------------------------------------------------------------

my @asked = @ARGV;
my $read_only = @asked && $asked[0] eq 'read' && shift @asked;
my $page_only = @asked && $asked[0] eq 'page' && shift @asked;
my @wanted;
if (@asked && $asked[0] ne 'all') {
    for my $name (@asked) {
        my $r = $run{$name} ? $name : $target{$name} ? $target{$name}{run} : undef;
        $target{$name} || $run{$name} or do { print STDERR "measure: $name: expected all, a target (@targets) or a run (@runs)\n"; exit 2 };
        if (!$r) { print "measure: $name has no command here: ", $target{$name}{why} // 'see its note', "\n"; next }
        push @wanted, $r if !grep { $_ eq $r } @wanted;
    }
} else {
    @wanted = grep { $read_only ? -f "$logs/$_.meta" : @asked || $run{$_}{cost} <= CHEAP_CPU_S } @runs;
}
read_figures();
if (!$page_only) {
    for my $r (map { $run{$_} } @wanted) {
        measure($r) if !$read_only;
        read_figures(); # another one may have written meanwhile
        read_log($r);
        write_figures(); # a long list that is broken off keeps what it has
    }
}
read_figures();
fill_in();
write_figures();
write_page();
